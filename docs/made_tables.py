"""Hook of the site: a line `::: made NAME [ARGUMENT]` becomes a table, made from the code."""

import re
from collections.abc import Iterable
from typing import Any

LINE = re.compile(r"^::: made (\w+)(?: (\S+))?$", re.MULTILINE)


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Put the tables into a page."""
    return with_tables(markdown)


def with_tables(markdown: str) -> str:
    """Return a page with its tables in place of the lines that name them."""
    return LINE.sub(lambda line: MADE[line[1]](*filter(None, [line[2]])), markdown)


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = list(heads)
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |"
                     for line in lines)


def _summary(thing: Any) -> str:
    return (thing.__doc__ or "").strip().split("\n")[0]


def options(command: str) -> str:
    """Arguments and options of a command, as `--help` has them."""
    from typer.main import get_command

    if command == "marl.fedqmix":
        from marl.fedqmix.__main__ import app
        found: Any = get_command(app)
    else:
        from radiotwin.cli.commands import app
        found = get_command(app).commands[command]  # type: ignore[attr-defined]
    rows = []
    for each in found.params:
        if getattr(each, "hidden", False) or each.name == "help":
            continue
        names = each.opts if each.param_type_name == "option" else [each.name.upper()]
        has_default = not (each.default is None or each.default is False or each.default == ""
                           or callable(each.default))
        given = f"`{each.default}`" if has_default else ""
        rows.append([", ".join(f"`{name}`" for name in names),
                     "needed" if each.required else given, " ".join((each.help or "").split())])
    return _table(["argument or option", "default", "meaning"], rows)


def effects() -> str:
    """All effects: what they are, parameters with unit and bounds, whether they need a map."""
    from radiotwin.effects.registry import BUILT_IN

    rows: dict[tuple[str, str], list[str]] = {}
    for effect in BUILT_IN:
        parameters = []
        for name, field in effect.Params.model_fields.items():
            extra = field.json_schema_extra
            if isinstance(extra, dict) and "unit" in extra:
                parameters.append(f"`{name}` {extra['low']:g} to {extra['high']:g} {extra['unit']}")
        summary = _summary(effect)
        rows[effect.name, effect.variant] = [
            f"`{effect.name}`", summary + (f" ({effect.variant})" if effect.variant else ""),
            ", ".join(parameters), "yes" if effect.needs_map else "",
            "" if effect.is_cause else "no cause"]
    return _table(["name", "what (variant)", "parameters that are searched for", "needs a map", ""],
                  [rows[key] for key in sorted(rows)])


def formats() -> str:
    """Known formats of logs. Of nested fields the table has the last part of the name."""
    from radiotwin.importing.formats import FORMATS

    rows = []
    for each in FORMATS:
        entries = [name for entry in each.columns.values()
                   for name in ([entry] if isinstance(entry, str) else entry)]
        fields = ", ".join(dict.fromkeys(name.rpartition(".")[2] for name in entries))
        rows.append([f"`{each.name}`", each.title, fields, each.level, each.source])
    return _table(["`--format`", "program", "fields used", "level", "description"], rows)


def schema() -> str:
    """Keys of `closeloop.json` and of the records in it, from the schema by which it is read."""
    from radiotwin.closeloop.output import result_schema

    base = result_schema.Record
    records = [each for each in vars(result_schema).values()
               if isinstance(each, type) and issubclass(each, base) and each is not base]
    return _table(["record", "what", "keys"], [
        [each.__name__.removesuffix("Record"), _summary(each),
         ", ".join(f"`{key}`" for key in each.model_fields)] for each in records])


def columns(table: str) -> str:
    """Columns of `measurements` and of `devices`: those that are needed, and the others."""
    from radiotwin.links import measurements

    groups = ((measurements.REQUIRED, measurements.OPTIONAL) if table == "measurements"
              else (measurements.DEVICE_REQUIRED, measurements.DEVICE_OPTIONAL))
    return _table(["needed", "optional"],
                  [[", ".join(f"`{each}`" for each in group) for group in groups]])


MADE = {each.__name__: each for each in (options, effects, formats, schema, columns)}
