"""The layout of the code: which package imports which, read from the source."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_LINES = 600
# Packages and modules of radiotwin from the bottom: each imports only what is in earlier rows.
ORDER = (
    {"errors"},
    {"inference", "io"},
    {"runtime", "geo"},
    {"display"},
    {"scene"},
    {"links"},
    {"importing", "maps"},
    {"trace"},
    {"propagation"},
    {"effects"},
    {"twin"},
    {"closeloop", "coverage"},
    {"report"},
    {"cli"},
    {"__main__"},
)
HEIGHT = {part: height for height, row in enumerate(ORDER) for part in row}
# What planning takes of radiotwin ends at its objects: not how a city is traced, and not how a twin is corrected.
NOT_FOR_MARL = ("radiotwin.cli", "radiotwin.closeloop", "radiotwin.report", "radiotwin.trace.", "sionna", "mitsuba",
                "drjit")


def name_of(path):
    """Return the module's dotted name; a package's is that of its folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for folder in ("radiotwin", "marl", "studies") for path in (ROOT / folder).rglob("*.py")}


def imported(module):
    """Return dotted names that a module imports, in functions, too, but not for type checkers alone."""
    path, found = MODULES[module], set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]

    def visit(node):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            children = node.orelse
        else:
            children = ast.iter_child_nodes(node)
        for child in children:
            if isinstance(child, ast.Import):
                found.update(alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                above = package.split(".")[:len(package.split(".")) - child.level + 1] if child.level else []
                source = ".".join([*above, *([child.module] if child.module else [])])
                found.update(f"{source}.{alias.name}" for alias in child.names)
            else:
                visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


IMPORTS = {module: imported(module) for module in MODULES}
# Names of the top level, which loads them when they are asked for -> the module that they are from.
TOP_LEVEL = {alias.name: node.module for node in ast.walk(ast.parse(MODULES["radiotwin"].read_text(encoding="utf-8")))
             if isinstance(node, ast.ImportFrom) for alias in node.names}


def target(name):
    """Return the module that an imported name is, or is defined in; None where it is none of ours."""
    return next((each for each in (name, name.rpartition(".")[0]) if each in MODULES), None)


def part_of(module):
    """Return the package or module directly below `radiotwin`; empty for `radiotwin` itself."""
    return module.split(".")[1] if "." in module else ""


def in_package(folder):
    return [module for module in MODULES if module.split(".")[0] == folder]


def test_every_part_has_its_place():
    assert {part_of(module) for module in in_package("radiotwin")} - {""} == set(HEIGHT)


@pytest.mark.parametrize("part", sorted(HEIGHT))
def test_a_package_imports_only_what_is_below_it(part):
    upwards = {f"{module} imports {name}" for module in in_package("radiotwin") if part_of(module) == part
               for name in IMPORTS[module] if (target(name) or "").startswith("radiotwin.")
               and part_of(target(name)) not in ("", part)
               and HEIGHT[part_of(target(name))] >= HEIGHT[part]}
    assert not upwards


def test_of_the_top_level_only_the_version_is_imported():
    """Except by the commands, which nothing imports: a circle through its names, which are loaded late, would not be seen."""
    below = [module for module in in_package("radiotwin") if part_of(module) != "cli"]
    wrong = {f"{module} imports {name}" for module in below for name in IMPORTS[module]
             if target(name) == "radiotwin" and name not in ("radiotwin", "radiotwin.__version__")}
    read = {f"{module} reads {node.value.id}.{node.attr}" for module in below
            if "radiotwin" in IMPORTS[module] for node in ast.walk(ast.parse(MODULES[module].read_text()))
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "radiotwin"
            and node.attr != "__version__"}
    assert not wrong | read


@pytest.mark.parametrize("folder", ["radiotwin", "marl", "studies"])
def test_no_modules_import_each_other_in_a_circle(folder):
    graph = {module: {target(name) for name in IMPORTS[module]} - {None, module} for module in in_package(folder)}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_of_radiotwin_the_command_that_plans_alone_imports_marl_and_nothing_imports_studies():
    used = {f"{module} imports {name}" for module in in_package("radiotwin") for name in IMPORTS[module]
            if name.split(".")[0] in ("marl", "studies") and (module, name.split(".")[0]) !=
            ("radiotwin.cli.planning", "marl")}
    assert not used | {name for module in in_package("marl") for name in IMPORTS[module] if name.startswith("studies")}


def test_marl_takes_maps_and_twins_and_not_what_made_them():
    wrong = set()
    for module in in_package("marl"):
        for name in IMPORTS[module]:
            package, _, attribute = name.rpartition(".")
            source = TOP_LEVEL.get(attribute, "") if package == "radiotwin" else ""
            if (source or target(name) or name).startswith(NOT_FOR_MARL):
                wrong.add(f"{module} imports {name}")
    assert not wrong


def test_modules_are_short():
    lines = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in MODULES.items()}
    assert not {module: count for module, count in lines.items() if count > MAX_LINES}


def test_effects_of_the_catalogue_are_imported_by_the_registry_alone():
    catalogue = "radiotwin.effects.catalogue"
    wrong = {f"{module} imports {name}" for module in MODULES for name in IMPORTS[module]
             if (target(name) or "").startswith(f"{catalogue}.") and module != "radiotwin.effects.registry"
             and module.startswith("radiotwin.")}
    assert not wrong
