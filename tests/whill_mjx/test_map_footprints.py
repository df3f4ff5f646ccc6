"""Footprints of made towns: coordinate systems, parts of buildings, relations of ways, templates."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from whill_mjx.maps import Import, main
from whill_mjx.world.maps import OCCUPIED, load_footprints
from whill_mjx.world.maps.coordinates import IN_DEGREES, IN_FEET, System, system_of, to_world

pytestmark = pytest.mark.quick
LATITUDE, LONGITUDE = 35.0, 139.0
NORTH, EAST = 110_941.0, 91_288.0
"""Metres per degree there, of the WGS84 ellipsoid."""
UTM = 691_000.0, 5_334_000.0
LONGITUDE_FIRST = (
    "urn:ogc:def:crs:OGC:1.3:CRS84", "http://www.opengis.net/def/crs/OGC/1.3/CRS84", "CRS:84", "OGC:CRS84h",
)
TURNED = "0 -1 0 0 1 0 0 0 0 0 1 0 0 0 0 1"
"""A quarter to the left."""


def corners(x, y, width, height):
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)]


def ring(places, height=" 7", attribute=""):
    points = " ".join(f"{x!r} {y!r}{height}" for x, y in places)
    return f"<LinearRing><posList{attribute}>{points}</posList></LinearRing>"


def polygon(*rectangle, **options):
    return f"<Polygon><exterior>{ring(corners(*rectangle), **options)}</exterior></Polygon>"


def building(body, name="Building"):
    return f"<cityObjectMember><{name}>{body}</{name}></cityObjectMember>"


def city(*things, srs="EPSG:25832"):
    envelope = f'<boundedBy><Envelope srsName="{srs}"/></boundedBy>'
    return f'<CityModel xmlns:xlink="x" xmlns:gml="g">{envelope}{"".join(things)}</CityModel>'


def load(folder, text, **options):
    path = folder / ("town.osm" if text.startswith("<osm") else "town.gml")
    path.write_text(text)
    return load_footprints(path, **options)


def is_wall(grid, *place):
    """Whether a place [m] of the world is within a footprint."""
    column, row = ((np.array(place) - grid.origin[:2]) / grid.resolution).astype(int)
    return bool(grid.cells[row, column] == OCCUPIED)


def area(grid):
    """Area of all footprints [m2], and its unsharpness: a cell that a border touches is a wall."""
    return float((grid.cells == OCCUPIED).sum() * grid.resolution**2)


def about(width, height):
    """Area of a rectangle in cells of 0.1 m, of which a row and a column more are touched."""
    return pytest.approx((width + 0.05) * (height + 0.05), abs=0.06 * (width + height + 0.2))


def test_projected_places_lie_around_the_whole_metre_at_their_middle(tmp_path, capsys):
    east, north = UTM
    text = city(building(f"<lod0FootPrint>{polygon(east + 0.25, north + 0.5, 20.0, 10.0)}</lod0FootPrint>"))
    grid = load(tmp_path, text)
    np.testing.assert_allclose(grid.origin, (-9.75 - 10.0, -5.5 - 10.0, 0.0), atol=1e-6)
    assert area(grid) == about(20, 10)
    assert grid.shift == (691_010.0, 5_334_006.0) and not grid.notes
    main(Import(tmp_path / "town.gml", tmp_path / "scene", pixels=100))
    assert "add 691010, 5334006 m" in capsys.readouterr().out
    with np.load(tmp_path / "scene.npz") as arrays:
        assert tuple(arrays["shift"]) == grid.shift and np.abs(arrays["walls"]).max() < 40.0


def test_the_command_prints_where_the_middle_is_and_what_is_left_out(tmp_path, capsys):
    text = town([("outer", 4)], [4, 5]).replace('<way id="5">', '<way id="5"><tag k="building" v="yes"/>')
    grid = load(tmp_path, text)
    assert area(grid) == about(20, 10) and grid.shift == (0.0, 0.0)
    assert "latitude 35.0000" in grid.notes[0] and "way 5" in grid.notes[1]
    main(Import(tmp_path / "town.osm", tmp_path / "scene", pixels=100))
    printed = capsys.readouterr().out
    assert all(note in printed for note in grid.notes)


def test_a_building_and_its_parts_stand_for_themselves(tmp_path):
    def with_part(own, part):
        held = f"<consistsOfBuildingPart><BuildingPart>{part}</BuildingPart></consistsOfBuildingPart>"
        return city(building(own + held))

    body = f"<lod1Solid>{polygon(0.0, 0.0, 12.0, 9.9)}</lod1Solid>"
    annexe = f"<lod1Solid>{polygon(12.0, 0.0, 4.0, 3.3)}</lod1Solid>"
    both = area(load(tmp_path, with_part(body, annexe)))
    assert both == pytest.approx(12.1 * 10.0 + 4.0 * 3.4, abs=2.0)
    alone = area(load(tmp_path, with_part("<measuredHeight>9</measuredHeight>", annexe)))
    assert alone == about(4, 3.3)
    # The ground of a part says nothing of the body: each has the first kind of ground that it has itself.
    ground = f"<boundedBy><GroundSurface>{polygon(12.0, 0.0, 4.0, 3.3)}</GroundSurface></boundedBy>"
    assert area(load(tmp_path, with_part(body, ground + polygon(0.0, 50.0, 9.0, 9.0)))) == pytest.approx(both)


@pytest.mark.parametrize("surface", ["PolygonPatch", "Triangle", "Rectangle"])
def test_surfaces_may_have_other_pieces_than_polygons(tmp_path, surface):
    pieces = polygon(0.0, 0.0, 12.0, 9.0).replace("Polygon>", f"{surface}>")
    assert area(load(tmp_path, city(building(f"<Surface><patches>{pieces}</patches></Surface>")))) == about(12, 9)


def test_a_hole_whose_border_is_missing_is_no_building(tmp_path):
    hole = f"<Polygon><exterior><Ring/></exterior><interior>{ring(corners(30.0, 0.0, 5.0, 5.0))}</interior></Polygon>"
    assert area(load(tmp_path, city(building(polygon(0.0, 0.0, 6.0, 4.0) + hole)))) == about(6, 4)
    ground = f"<lod0FootPrint>{hole}</lod0FootPrint>"  # none that can be read
    assert area(load(tmp_path, city(building(polygon(0.0, 0.0, 6.0, 4.0) + ground)))) == about(6, 4)


@pytest.mark.parametrize("srs", [
    "EPSG:4326", "urn:ogc:def:crs:EPSG::4269", "urn:ogc:def:crs:EPSG:9.1:4267", "EPSG:4283", "EPSG:7844", "EPSG:6318",
    "http://www.opengis.net/gml/srs/epsg.xml#4171", "http://www.opengis.net/def/crs/EPSG/0/4167", "EPSG:4258",
    "urn:ogc:def:crs:EPSG::4979", "urn:ogc:def:crs:EPSG::4937", "urn:ogc:def:crs,crs:EPSG::4258,crs:EPSG::5783",
    "http://www.opengis.net/def/crs/EPSG/0/6697/", *LONGITUDE_FIRST,
])  # fmt: skip
def test_degrees_of_every_usual_system_become_metres(tmp_path, srs):
    places = [(LATITUDE + y / NORTH, LONGITUDE + x / EAST) for x, y in corners(0.0, 0.0, 20.0, 10.0)]
    if srs in LONGITUDE_FIRST:
        places = [place[::-1] for place in places]
    grid = load(tmp_path, city(building(f"<Polygon><exterior>{ring(places)}</exterior></Polygon>"), srs=srs))
    assert area(grid) == about(20, 10) and grid.cells.shape[1] > grid.cells.shape[0]
    assert "latitude 35.0000" in grid.notes[0] and "longitude 139.000" in grid.notes[0]


def test_an_unknown_system_in_degrees_is_refused(tmp_path):
    def town(size, srs, x=LONGITUDE, y=LATITUDE):
        return city(building(polygon(x, y, size, size)), srs=srs)

    for srs in ("urn:x:somewhere", "EPSG:6677"):
        with pytest.raises(ValueError, match="look like degrees; reproject it to metres") as error:
            load(tmp_path, town(2e-4, srs))
        assert srs in str(error.value) and "35, 139" not in str(error.value) and "139, 35" in str(error.value)
    assert area(load(tmp_path, town(4.0, "urn:x:somewhere"))) == about(4, 4)
    # A pole of street furniture at a place that no angle has.
    assert area(load(tmp_path, town(0.5, "EPSG:25832", *UTM))) == about(0.5, 0.5)
    with pytest.raises(ValueError, match="latitude of 139.* over 90"):
        load(tmp_path, town(2e-4, "EPSG:4326"))


def test_feet_become_metres_by_their_code_or_by_scale(tmp_path):
    feet = building(polygon(980_000.0, 190_000.0, 20 / 0.3048, 10 / 0.3048))
    known = load(tmp_path, city(feet, srs="urn:ogc:def:crs:EPSG::2263"))
    assert area(known) == about(20, 10) and "EPSG::2263: 0.3048 m" in known.notes[0]
    assert area(load(tmp_path, city(feet, srs="EPSG:6539"))) == about(20, 10)
    in_metres = load(tmp_path, city(feet, srs="EPSG:6538"))  # the same zone
    assert area(in_metres) == about(20 / 0.3048, 10 / 0.3048)
    scaled = load(tmp_path, city(feet, srs="urn:x:feet"), scale=0.3048)
    assert area(scaled) == about(20, 10) and (scaled.origin, scaled.shift) == (known.origin, known.shift)
    with pytest.raises(ValueError, match="is in degrees .* --scale 0.3048 has no meaning"):
        load(tmp_path, city(building(polygon(35.0, 139.0, 1e-4, 1e-4)), srs="EPSG:4326"), scale=0.3048)


def test_no_code_is_both_in_degrees_and_in_feet():
    assert not IN_DEGREES & IN_FEET
    assert {2229, 2263, 2272, 6539, 6565, 32018} <= IN_FEET and not {25832, 32118, 6677, 3857, 6564, 32632} & IN_FEET
    assert not {25832, 4647, 4839, 4087, 3857, 6677} & IN_DEGREES  # four digits do not make a system geographic


def test_two_kinds_of_coordinates_in_one_file_are_refused_and_the_nearest_name_counts(tmp_path):
    near = polygon(LONGITUDE, LATITUDE, 20 / EAST, 10 / NORTH).replace("<Polygon", '<Polygon srsName="OGC:CRS84"')
    assert area(load(tmp_path, city(building(near)))) == about(20, 10)
    with pytest.raises(ValueError, match="mixes coordinate systems .*Reproject"):
        load(tmp_path, city(building(near), building(polygon(*UTM, 9.0, 9.0))))


SIX = [(0, 0), (6, 0), (12, 0), (12, 9), (0, 9), (0, 0)]
"""Twelve numbers: they could be four points of three."""


@pytest.mark.parametrize("holder", ["MultiSurface", "Polygon", "exterior", "LinearRing", "posList", "none"])
def test_the_dimension_of_points_may_stand_on_any_element_around_them(tmp_path, holder):
    text = f"<MultiSurface><Polygon><exterior>{ring(SIX, height='')}</exterior></Polygon></MultiSurface>"
    text = text.replace(f"<{holder}>", f'<{holder} srsDimension="2">')
    grid = load(tmp_path, city(building(f"<lod0FootPrint>{text}</lod0FootPrint>")))
    assert area(grid) == about(12, 9)
    assert grid.cells.shape == (9 * 10 + 200, 12 * 10 + 200)


def test_the_nearest_dimension_counts_and_single_points_have_their_own(tmp_path):
    deep = polygon(0.0, 0.0, 12.0, 9.0, attribute=' srsDimension="3"').replace("<Polygon", '<Polygon srsDimension="2"')
    assert area(load(tmp_path, city(building(deep)))) == about(12, 9)
    older = " ".join(f"{x},{y}" for x, y in SIX)
    for points in ("".join(f"<pos>{x} {y}</pos>" for x, y in SIX), f"<coordinates>{older}</coordinates>"):
        flat = f"<Polygon><LinearRing>{points}</LinearRing></Polygon>"
        assert area(load(tmp_path, city(building(flat)))) == about(12, 9)
    for size in ("4", "x"):
        with pytest.raises(ValueError, match=f"points of {size} numbers"):
            load(tmp_path, city(building(deep.replace('"3"', f'"{size}"'))))


def implicit(template, place, matrix=TURNED):
    return building("<lod2ImplicitRepresentation><ImplicitGeometry>"
                    f"<transformationMatrix>{matrix}</transformationMatrix>{template}<referencePoint><Point><pos>{place}"
                    "</pos></Point></referencePoint></ImplicitGeometry></lod2ImplicitRepresentation>", "CityFurniture")


BENCH = ('<relativeGMLGeometry><MultiSurface gml:id="bench">'
         f"{polygon(0.0, 0.0, 3.0, 1.0)}</MultiSurface></relativeGMLGeometry>")
AGAIN = '<relativeGMLGeometry xlink:href="#bench"/>'


def test_a_template_stands_where_each_reference_point_puts_it(tmp_path):
    east, north = UTM
    house = building(polygon(east, north, 20.0, 10.0))
    grid = load(tmp_path, city(house, implicit(BENCH, f"{east + 5} {north + 14} 500"),
                               implicit(AGAIN, f"{east + 15} {north + 14} 500")))  # fmt: skip
    assert area(grid) == pytest.approx(20.1 * 10.1 + 2 * 1.1 * 3.1, abs=2.0)
    middle = np.array([10.0, 8.0 + 0.5])  # of all, 17 m from south to north, to the next even whole metre
    shift = np.rint(np.array(UTM) + middle) - UTM
    for x in (5.0, 15.0):  # turned to the left, 3 m reach north and 1 m west
        assert is_wall(grid, *([x - 0.5, 16.5] - shift)) and not is_wall(grid, *([x + 0.5, 14.5] - shift))


def test_a_template_in_metres_stands_at_a_place_in_degrees(tmp_path):
    house = [(LATITUDE + y / NORTH, LONGITUDE + x / EAST) for x, y in corners(0.0, 0.0, 20.0, 10.0)]
    bench = implicit(BENCH, f"{LATITUDE + 20 / NORTH:.9f} {LONGITUDE + 10 / EAST:.9f} 0")
    for srs, order in (("EPSG:6697", 1), ("OGC:CRS84", -1)):
        there = f"<Polygon><exterior>{ring([place[::order] for place in house])}</exterior></Polygon>"
        place = bench if order == 1 else implicit(BENCH, f"{LONGITUDE + 10 / EAST:.9f} {LATITUDE + 20 / NORTH:.9f} 0")
        grid = load(tmp_path, city(building(there), place, srs=srs))
        assert area(grid) == pytest.approx(20.1 * 10.1 + 1.1 * 3.1, abs=3.0)
        assert is_wall(grid, -0.5, 21.5 - 11.5) and not is_wall(grid, 0.5, 20.5 - 11.5)  # 23 m from south to north


@pytest.mark.parametrize("template", [
    "<libraryObject>lamp.wrl</libraryObject>", '<relativeGMLGeometry xlink:href="#nothing"/>', "",
])  # fmt: skip
def test_what_a_missing_template_would_draw_is_left_out_with_a_note(tmp_path, template):
    house = building(polygon(*UTM, 20.0, 10.0))
    grid = load(tmp_path, city(house, implicit(template, "691005 5334005 0")))
    assert area(grid) == about(20, 10)
    assert any("1 left out" in note for note in grid.notes)


def test_a_template_that_places_itself_ends(tmp_path):
    inner = '<ImplicitGeometry gml:id="loop"><relativeGMLGeometry xlink:href="#loop"/></ImplicitGeometry>'
    loop = implicit(BENCH.replace("</MultiSurface>", inner + "</MultiSurface>"), "691005 5334005 0", TURNED)
    grid = load(tmp_path, city(loop))
    assert area(grid) == about(1, 3) and any("1 left out" in note for note in grid.notes)


NODES = {1: (0, 0), 2: (20, 0), 3: (20, 10), 4: (0, 10), 5: (5, 3), 6: (10, 3), 7: (10, 7), 8: (5, 7),
         11: (40, 0), 12: (50, 0), 13: (50, 10), 14: (40, 10), 15: (6, 4), 16: (9, 4), 17: (9, 6), 18: (6, 6)}
WAYS = {1: (1, 2, 3), 2: (3, 4, 1), 3: (5, 6, 7, 8, 5), 4: (1, 2, 3, 4, 1), 5: (11, 12, 13), 6: (13, 14, 11),
        7: (15, 16, 17, 18, 15)}


def town(members, ways, kind="multipolygon"):
    """OSM XML of one building relation; members are (role, way) or (role, type, ref)."""
    used = "".join(f'<node id="{key}" lat="{LATITUDE + y / NORTH:.9f}" lon="{LONGITUDE + x / EAST:.9f}"/>'
                   for key, (x, y) in NODES.items())
    for key in ways:
        used += f'<way id="{key}">' + "".join(f'<nd ref="{node}"/>' for node in WAYS[key]) + "</way>"
    parts = "".join(f'<member type="{rest[0] if len(rest) > 1 else "way"}" ref="{rest[-1]}" role="{role}"/>'
                    for role, *rest in members)
    tags = f'<tag k="type" v="{kind}"/><tag k="building" v="yes"/>'
    return f'<osm version="0.6">{used}<relation id="77">{parts}{tags}</relation></osm>'


HOLE = 5 * 4 - 0.1 * 9
"""Free area of a courtyard [m2]: the cells that its border touches are walls."""


@pytest.mark.parametrize(("members", "kind", "expected"), [
    ([("outer", 1), ("outer", 2), ("inner", 3)], "multipolygon", 20.1 * 10.1 - HOLE),
    ([("", 1), ("outer", 2), ("inner", 3)], "multipolygon", 20.1 * 10.1 - HOLE),
    ([("outer", 4), ("", "node", 3)], "multipolygon", 20.1 * 10.1),
    ([("", 4), ("", 3)], "multipolygon", 20.1 * 10.1 - HOLE),
    ([("", 4), ("", 5), ("", 6)], "multipolygon", 20.1 * 10.1 + 10.1**2),
    ([("outer", 4), ("inner", "relation", 3)], "multipolygon", 20.1 * 10.1),
    ([("outline", 4), ("part", 3)], "building", 20.1 * 10.1),
    ([("outer", 4), ("outer", 4)], "multipolygon", 20.1 * 10.1),
    ([("outer", 1), ("outer", 2), ("outer", 1)], "multipolygon", 20.1 * 10.1),
    ([("outer", 4), ("inner", 3), ("outer", 7)], "multipolygon", 20.1 * 10.1 - HOLE + 3.1 * 2.1),  # an island
    ([("outer", 5), ("outer", 6), ("outer", 4), ("inner", 3)], "multipolygon", 20.1 * 10.1 - HOLE + 10.1**2),
])  # fmt: skip
def test_a_relation_is_its_outer_ways_without_its_inner_ones(tmp_path, members, kind, expected):
    for order in (members, members[::-1]):
        grid = load(tmp_path, town(order, WAYS, kind))
        assert area(grid) == pytest.approx(expected, abs=4.5)
        assert len(grid.notes) == 1


def test_pieces_of_a_relation_and_deleted_ways_are_no_buildings_left_out(tmp_path):
    text = town([("outer", 1), ("outer", 2)], [1, 2]).replace("</way>", '<tag k="building" v="yes"/></way>')
    text = text.replace("<relation", '<way id="9" visible="false"><tag k="building" v="yes"/></way><relation')
    assert len(load(tmp_path, text).notes) == 1  # how degrees became metres


@pytest.mark.parametrize(("attribute", "tag", "there"), [
    ('action="delete"', "", False), ('action="modify"', "", True), ('visible="false"', "", False),
    ("", '<tag k="min_height" v="5"/>', False), ("", '<tag k="min_height" v="4.5 m"/>', False),
    ("", '<tag k="min_height" v="16\'5&quot;"/>', False), ("", '<tag k="min_height" v="1"/>', True),
    ("", '<tag k="min_height" v="low"/>', True), ("", '<tag k="building:min_level" v="2"/>', False),
    ("", '<tag k="building:min_level" v="0"/>', True),
])  # fmt: skip
def test_what_an_editor_deleted_and_what_a_vehicle_passes_below_is_no_building(tmp_path, attribute, tag, there):
    corners = "".join(f'<nd ref="{node}"/>' for node in (11, 12, 13, 14, 11))
    way = f'<way id="9" {attribute}>{corners}<tag k="building" v="yes"/>{tag}</way>'
    grid = load(tmp_path, town([("outer", 4)], [4]).replace("<relation", f"{way}<relation"))
    assert area(grid) == pytest.approx(20.1 * 10.1 + (10.1**2 if there else 0.0), abs=4.5)
    relation = town([("outer", 4)], [4]).replace('<relation id="77"', f'{way}<relation id="77" action="delete"')
    if there:
        assert area(load(tmp_path, relation)) == pytest.approx(10.1**2, abs=4.5)


def test_a_border_that_lacks_corners_is_drawn_without_them_and_named(tmp_path):
    text = town([("outer", 1), ("outer", 2)], [1, 2, 5])
    own = '<way id="8"><nd ref="11"/><nd ref="12"/><nd ref="13"/><nd ref="14"/><nd ref="11"/>'
    text = text.replace("<relation", own + '<tag k="building" v="yes"/></way><relation')
    both = pytest.approx(20.1 * 10.1 + 10.1**2, abs=4.5)
    grid = load(tmp_path, text)
    assert len(grid.notes) == 1 and area(grid) == both
    for after, name in (("2", "relation 77"), ("14", "way 8")):
        grid = load(tmp_path, text.replace(f'<nd ref="{after}"/>', f'<nd ref="{after}"/><nd ref="90"/>'))
        assert area(grid) == both and len(grid.notes) == 2
        assert grid.notes[1].endswith(f"corners that are not in the file, drawn without them: {name}")


def test_a_way_that_has_the_tags_of_its_relation_keeps_the_courtyards(tmp_path):
    text = town([("outer", 4), ("inner", 3)], [3, 4])
    tagged = text.replace('<way id="4">', '<way id="4"><tag k="building" v="yes"/>')
    assert area(load(tmp_path, tagged)) == area(load(tmp_path, text)) == pytest.approx(20.1 * 10.1 - HOLE, abs=4.5)


def test_a_relation_that_is_cut_off_leaves_no_building_of_its_courtyard(tmp_path):
    cut = [("outer", 1), ("outer", 2), ("inner", 3)]
    with pytest.raises(ValueError, match=r"no building with a footprint \(.*relation 77"):
        load(tmp_path, town(cut, [1, 3]))
    with pytest.raises(ValueError, match="no building with a footprint"):
        load(tmp_path, town([("inner", 3)], [3]))
    # Another outer ring of it is whole: it stays, and the courtyard of the cut one belongs to no ring.
    grid = load(tmp_path, town([*cut, ("outer", 5), ("outer", 6)], [1, 3, 5, 6]))
    assert area(grid) == about(10, 10)
    assert any("relation 77" in note for note in grid.notes)


@pytest.mark.parametrize("system", [System(), System(0.3048), System(None), System(None, True)])
def test_places_beside_a_place_are_that_far_from_it(system):
    unit, start = system.unit or 1.0, np.array(UTM)
    if system.unit is None:
        start = np.array([LONGITUDE, LATITUDE] if system.longitude_first else [LATITUDE, LONGITUDE])
    off = np.array([[0.0, 0.0], [30.0, -4.0], [-7.0, 12.0]])
    world = to_world(system.beside(start, off), system, "here").places
    for a, b in itertools.pairwise(range(3)):
        np.testing.assert_allclose(world[b] - world[a], (off[b] - off[a]) * unit, atol=1e-4)
    assert system_of("EPSG:4326") == System(None)
