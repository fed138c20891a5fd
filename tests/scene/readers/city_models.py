"""Made-up city models: gabled houses of 10 x 12 m, 6 m to the eaves and 9 m to the ridge, as CityJSON and CityGML."""

WIDTH_M, LENGTH_M, EAVES_M, RIDGE_M = 10.0, 12.0, 6.0, 9.0
VOLUME_M3 = WIDTH_M * LENGTH_M * (EAVES_M + RIDGE_M) / 2
# Rings of corners, counter-clockwise from outside, and the kind of each surface
FACES = [([0, 3, 2, 1], "GroundSurface"), ([0, 1, 5, 8, 4], "WallSurface"), ([1, 2, 6, 5], "WallSurface"),
         ([2, 3, 7, 9, 6], "WallSurface"), ([3, 0, 4, 7], "WallSurface"), ([4, 8, 9, 7], "RoofSurface"),
         ([5, 6, 9, 8], "RoofSurface")]
KINDS = ["RoofSurface", "WallSurface", "GroundSurface"]


def corners(x, y, z):
    w, n, h, r = WIDTH_M, LENGTH_M, EAVES_M, RIDGE_M
    return [(x, y, z), (x + w, y, z), (x + w, y + n, z), (x, y + n, z), (x, y, z + h), (x + w, y, z + h),
            (x + w, y + n, z + h), (x, y + n, z + h), (x + w / 2, y, z + r), (x + w / 2, y + n, z + r)]


def cityjson(houses, system="https://www.opengis.net/def/crs/EPSG/0/7415", lod="2.2", at=(85_000, 446_000), **attributes):
    """A building with an outline (LoD 0) and a part with a solid at each (x, y, z), as 3D BAG has them."""
    vertices, objects = [], {}
    for number, (x, y, z) in enumerate(houses):
        first, name = len(vertices), f"B{number}"
        vertices += [[round(1000 * value) for value in corner] for corner in corners(x, y, z)]
        outline = {"type": "MultiSurface", "lod": "0", "boundaries": [[[first + i for i in (0, 1, 2, 3)]]]}
        solid = {"type": "Solid", "lod": lod, "boundaries": [[[[first + i for i in ring]] for ring, _ in FACES]],
                 "semantics": {"surfaces": [{"type": kind} for kind in KINDS],
                               "values": [[KINDS.index(kind) for _, kind in FACES]]}}
        objects[name] = {"type": "Building", "attributes": attributes, "children": [f"{name}-0"], "geometry": [outline]}
        objects[f"{name}-0"] = {"type": "BuildingPart", "parents": [name], "geometry": [solid]}
    return {"type": "CityJSON", "version": "2.0", "metadata": {"referenceSystem": system} if system else {},
            "transform": {"scale": [0.001] * 3, "translate": [*at, 0.0]}, "CityObjects": objects, "vertices": vertices}


def in_one_building(model):
    """The houses of a model of `cityjson` as parts of its first building."""
    objects = model["CityObjects"]
    parts = [name for name in objects if name.endswith("-0")]
    objects["B0"]["children"] = parts
    return model | {"CityObjects": {"B0": objects["B0"]} | {name: objects[name] | {"parents": ["B0"]}
                                                            for name in parts}}


def polygon(points, name, dimension=3):
    text = " ".join(f"{value:.3f}" for point in [*points, points[0]] for value in point[:dimension])
    return (f'<gml:Polygon gml:id="{name}"><gml:exterior><gml:LinearRing><gml:posList srsDimension="{dimension}">{text}'
            "</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon>")


def surface(points, kind, name):
    return (f"<bldg:boundedBy><bldg:{kind}><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>"
            f"{polygon(points, name)}</gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface></bldg:{kind}>"
            "</bldg:boundedBy>")


def solid(members, lod=2):
    return (f"<bldg:lod{lod}Solid><gml:Solid><gml:exterior><gml:CompositeSurface>{members}</gml:CompositeSurface>"
            f"</gml:exterior></gml:Solid></bldg:lod{lod}Solid>")


def building(content, name, attributes=""):
    return (f'<core:cityObjectMember><bldg:Building gml:id="{name}">{attributes}{content}</bldg:Building>'
            "</core:cityObjectMember>")


def citygml(members, system="urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH"):
    return ('<?xml version="1.0" encoding="UTF-8"?><core:CityModel xmlns:core="http://www.opengis.net/citygml/2.0" '
            'xmlns:bldg="http://www.opengis.net/citygml/building/2.0" xmlns:gml="http://www.opengis.net/gml" '
            'xmlns:gen="http://www.opengis.net/citygml/generics/2.0" xmlns:xlink="http://www.w3.org/1999/xlink">'
            f'<gml:boundedBy><gml:Envelope srsDimension="3" srsName="{system}"><gml:lowerCorner>0 0 0</gml:lowerCorner>'
            f"</gml:Envelope></gml:boundedBy>{''.join(members)}</core:CityModel>")


def house(x, y, z, name, refer=True):
    """A building whose solid names the surfaces beside it, or, as of LoD 1 in Germany, holds them."""
    points, rows = corners(x, y, z), list(enumerate(FACES))
    if not refer:
        inside = "".join(f"<gml:surfaceMember>{polygon([points[i] for i in ring], f'{name}_{row}')}</gml:surfaceMember>"
                         for row, (ring, _) in rows)
        return building(solid(inside, lod=1), name)
    named = "".join(f'<gml:surfaceMember xlink:href="#{name}_{row}"/>' for row, _ in rows)
    beside = "".join(surface([points[i] for i in ring], kind, f"{name}_{row}") for row, (ring, kind) in rows)
    return building(solid(named) + beside, name, '<bldg:measuredHeight uom="urn:adv:uom:m">9.0</bldg:measuredHeight>')
