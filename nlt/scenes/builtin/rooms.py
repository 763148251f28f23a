"""The built-in scenes, as inventories of furniture. Shape ids are `piece_part`, or `piece` if it has only one part."""

from __future__ import annotations

from nlt.scenes.builtin.furniture import (
    area_light,
    bed,
    books,
    ceiling_light,
    chair,
    clock,
    cupboard,
    curtains,
    door,
    floor_lamp,
    hung,
    pendant,
    radiator,
    radiator_rail,
    room,
    shelf,
    skirting,
    sofa,
    spot_lamp,
    stool,
    table,
    table_lamp,
    uplight,
    wall_shelf,
    window,
)
from nlt.scenes.builtin.materials import (
    abstract,
    bricks,
    carpet,
    checks,
    cloth,
    diffuse,
    glass,
    grain,
    landscape,
    metal,
    mirror,
    planks,
    quilt,
    rgb,
    rough_plastic,
    sprigs,
    stripes,
    terrazzo,
    texture,
    tiles,
    wicker,
)
from nlt.scenes.builtin.objects import (
    basket,
    bottle,
    bowl,
    cup,
    egg_of,
    flowers,
    hob,
    hood,
    jar,
    jug,
    kettle,
    pan,
    plant,
    pot,
    tap,
    teddy,
    toaster,
    toilet,
    tub,
    tumbler,
    vase,
)
from nlt.scenes.builtin.shapes import Shapes, ball, boxes, join, lathe, place, rod, rounded, transform

SKY = (0.5, 0.8, 1.25)  # radiance of a window
OVERCAST = (0.35, 0.45, 0.6)  # reflectance of a window whose light is turned off


def egg() -> Shapes:
    """A scene after Veach: a lamp that lights the ceiling, a spot lamp in a shade, a glass egg on a table."""
    paint = diffuse(rgb(0.8, 0.76, 0.68))
    boards = rough_plastic(texture(planks((0.55, 0.4, 0.25))), 0.25)
    wood = diffuse(texture(grain((0.5, 0.3, 0.15))))
    steel = metal()
    dark = rough_plastic(rgb(0.04, 0.04, 0.045))
    return {
        **room((4.4, 2.6, 3.8), boards, paint, [paint] * 4),
        "skirting": skirting(wood, (4.4, 2.6, 3.8)),
        **place(table(wood, 1.5, 0.9, 0.62), "table", (0, 0, 0)),
        **place({"glass": egg_of(glass(), 0.36, (0, 0, 0))}, "egg", (0.1, 0.62, 0)),
        **place(spot_lamp(steel, dark, (130, 115, 90)), "spot", (-0.45, 0.62, 0)),
        **place(uplight(steel, dark, (330, 300, 255)), "uplight", (1.55, 0, -1.25)),
    }


def living_room() -> Shapes:
    """A living room of 5 x 2.6 x 4 m with a window, a ceiling lamp, a mirror and a glass ball."""
    size = (5.0, 2.6, 4.0)
    paint = diffuse(rgb(0.8, 0.8, 0.78))
    paper = diffuse(texture(stripes((0.72, 0.68, 0.56), (0.5, 0.58, 0.5))))
    accent = diffuse(rgb(0.68, 0.36, 0.25))
    boards = rough_plastic(texture(planks((0.5, 0.32, 0.18))), 0.25)
    wood = diffuse(texture(grain((0.42, 0.25, 0.13))))
    blue = diffuse(rgb(0.12, 0.24, 0.42))
    cream = diffuse(rgb(0.8, 0.72, 0.55))
    leaf = diffuse(rgb(0.1, 0.25, 0.07))
    check = diffuse(checks((0.8, 0.6, 0.15), (0.75, 0.72, 0.65)))
    rug = diffuse(texture(carpet([(0.5, 0.08, 0.07), (0.75, 0.55, 0.25), (0.08, 0.1, 0.25)])))
    picture, poster = diffuse(texture(landscape())), diffuse(texture(abstract()))
    steel, silver, crystal = metal(), mirror(), glass()
    pane = diffuse(rgb(*OVERCAST))
    glazed = rough_plastic(rgb(0.05, 0.35, 0.32), 0.1)
    dish = [(0, 0), (0.08, 0), (0.18, 0.07), (0.17, 0.075), (0.07, 0.015), (0, 0.015)]
    dining = {
        **table(wood),
        "bowl": lathe(glazed, dish, (0.25, 0.74, 0.1)),
        "cup": lathe(cream, [(0, 0), (0.04, 0), (0.045, 0.1), (0, 0.1)], (-0.35, 0.74, -0.15)),
    }
    stand = boxes(wood, ((0, 0.28, 0), (0.28, 0.56, 0.28)))
    return {
        **room(size, boards, paint, [accent, cream, paper, paper]),
        **place(window(1.5, 1.2, paint, pane, (3.8, 4.5, 5.5)), "window", (-0.5, 1.5, -2.0)),
        **place(ceiling_light(1.0, 1.0, (5.8, 5.0, 4.1), paint), "ceiling_lamp", (0, 2.6, 0)),
        "skirting": skirting(paint, size),
        "radiator": transform(radiator(paint, 1.2, 0.5), (-0.5, 0, -2.0)),
        **place(curtains(blue, wood, 1.62, 0.42, 1.55), "curtains", (-0.5, 2.3, -2.0)),
        **place(door(cream, paint, steel), "door", (1.95, 0, 2.0), 180),
        "rug": boxes(rug, ((0, 0.004, 0.1), (2.6, 0.008, 1.8)), tile=None),
        **place(dining, "table", (0, 0, -0.2)),
        **place(chair(wood, blue), "chair_1", (-1.0, 0, -0.2), 80),
        **place(chair(wood, blue), "chair_2", (1.0, 0, -0.1), -105),
        **place(sofa(blue, check), "sofa", (-0.3, 0, 1.53), 180),
        **place(shelf(wood), "shelf", (-2.34, 0, -0.6), 90),
        **place(floor_lamp(steel, cream), "lamp", (-2.1, 0, 1.55)),
        **place({"plinth": stand, "glass": ball(crystal, 0.2, (0, 0.76, 0))}, "ball", (1.9, 0, -1.5)),
        **place(vase(glazed), "vase", (-1.75, 0, -1.6)),
        **place(hung(silver, wood, 0.9, 1.1), "mirror", (2.5, 1.45, 0.2), -90),
        **place(hung(picture, wood, 0.9, 0.7), "picture", (-0.3, 1.55, 2.0), 180),
        **place(hung(poster, wood, 0.5, 0.65), "poster", (1.6, 1.6, -2.0)),
        **place(cupboard(wood, wood, steel, (1.3, 0.55, 0.4), 3), "sideboard", (2.28, 0, 0.2), -90),
        "books": transform(books(4), (2.3, 0.55, 0.55), 80),
        "dish": transform(bowl(glazed, 0.14, 0.09), (2.3, 0.55, -0.15)),
        **place(clock(cream, wood), "clock", (-2.5, 1.95, 1.2), 90),
        **place(plant(cream, leaf, 0.95), "plant", (2.12, 0, 1.3)),
    }


def bathroom() -> Shapes:
    """A bathroom of 3.4 x 2.5 x 3 m with a bath under the window and a basin under the mirror."""
    size = (3.4, 2.5, 3.0)
    paint = diffuse(rgb(0.8, 0.8, 0.78))
    wall = rough_plastic(texture(tiles([(0.66, 0.78, 0.76)], 4)), 0.12)
    plain = diffuse(rgb(0.74, 0.7, 0.6))
    floor = rough_plastic(texture(tiles([(0.72, 0.7, 0.66), (0.12, 0.15, 0.17)], 4)), 0.2)
    wood = diffuse(texture(grain((0.5, 0.33, 0.2))))
    ceramic = rough_plastic(rgb(0.85, 0.85, 0.83), 0.08)
    chips = [(0.3, 0.28, 0.27), (0.55, 0.35, 0.25), (0.85, 0.84, 0.8)]
    stone = rough_plastic(texture(terrazzo((0.7, 0.68, 0.64), chips)))
    chrome, silver, crystal = metal("Cr", 0.08), mirror(), glass()
    pane = diffuse(rgb(*OVERCAST))
    terry, rose = diffuse(texture(cloth((0.75, 0.45, 0.12)))), diffuse(texture(cloth((0.65, 0.2, 0.2))))
    weave = diffuse(texture(wicker((0.6, 0.42, 0.22))))
    leaf = diffuse(rgb(0.1, 0.27, 0.08))
    picture = diffuse(texture(landscape()))
    towel = lambda bsdf, width, length: rounded(bsdf, ((0, -length / 2, 0.085), (width, length, 0.05)), radius=0.025)
    vanity = cupboard(wood, wood, chrome, (1.0, 0.78, 0.48), 2, 1)
    rolls = [(-1, 1.355), (-0.87, 1.355), (-0.93, 1.448)]
    flasks = [(0.18, -0.6, 1.3), (0.13, -0.48, 1.3), (0.22, -0.8, 1.65)]
    bird = [((0, 0.035, 0), (1.25, 0.9, 1)), ((0.03, 0.085, 0), (0.65, 0.65, 0.65))]
    return {
        **room(size, floor, paint, [wall, plain, wall, plain], floor_tile=1.6),
        **place(window(1.1, 0.9, paint, pane, SKY, (2, 1), leaf), "window", (-0.6, 1.6, -1.5)),
        **place(ceiling_light(0.8, 0.8, (7.4, 6.7, 5.9), paint), "ceiling_lamp", (0.2, 2.5, 0.1)),
        **place(door(paint, paint, chrome), "door", (0.95, 0, 1.5), 180),
        **place(tub(ceramic), "tub", (-0.83, 0, -1.07)),
        "tub_tap": transform(join(tap(chrome, 0.78, 0.16)), (0.12, 0, -1.07), -90),
        "duck": transform(join(*(ball(terry, 0.045, at, s, 3) for at, s in bird)), (-0.6, 0.58, -0.72), -60),
        **place(toilet(ceramic, wood, chrome), "toilet", (0.85, 0, -1.16)),
        **place(vanity, "vanity", (1.45, 0, 0.1), -90),
        "vanity_top": boxes(stone, ((1.44, 0.8, 0.1), (0.52, 0.04, 1.04))),
        "basin": transform(bowl(ceramic, 0.2, 0.13, (0.95, 1, 1.3)), (1.42, 0.82, 0.1)),
        "basin_tap": transform(tap(chrome, 0.22, 0.14), (1.63, 0.82, 0.1), -90),
        "bottles": join(*(bottle(ceramic, h, 0.03, (1.5, 0.82, z)) for h, z in ((0.2, 0.5), (0.15, 0.41)))),
        "tumbler": tumbler(crystal, 0.12, 0.038, (1.46, 0.82, -0.27)),
        **place(hung(silver, wood, 0.9, 0.8), "mirror", (1.7, 1.55, 0.1), -90),
        **place(area_light(0.6, 0.09, (7, 6.5, 5.6), chrome), "mirror_lamp", (1.7, 2.13, 0.1), -90),
        "rail": transform(radiator_rail(chrome, 0.55, 1.2), (-1.7, 0.35, 0.1), 90),
        "towel": transform(join(towel(terry, 0.42, 0.62)), (-1.7, 1.42, 0.1), 90),
        "mat": boxes(rose, ((-0.75, 0.012, -0.25), (0.9, 0.024, 0.55))),
        **place(stool(wood), "stool", (0.25, 0, 0.95)),
        "stool_towels": rounded(rose, *(((0.25, y, 0.95), (0.26, 0.066, 0.2)) for y in (0.483, 0.549)), radius=0.03),
        "basket": transform(basket(weave), (-1.35, 0, 1.2)),
        "laundry": rounded(terry, ((-1.35, 0.38, 1.2), (0.34, 0.18, 0.26)), radius=0.12),
        "bin": lathe(chrome, [(0, 0), (0.11, 0), (0.12, 0.3), (0.1, 0.33), (0, 0.34)], (0.38, 0, -1.28)),
        **place(plant(weave, leaf, 0.85, 0.24), "plant", (1.35, 0, 1.2)),
        "scales": boxes(ceramic, ((1.0, 0.02, 0.72), (0.3, 0.04, 0.3))),
        "wall_shelf": transform(wall_shelf(wood, 0.8), (-0.75, 1.3, 1.5), 180),
        "rolls": join(*(rod(rose, (x, y, 1.31), (x, y, 1.49), 0.055) for x, y in rolls)),
        "jars": join(*(bottle(ceramic, h, 0.035, (x, y, 1.39)) for h, x, y in flasks)),
        **place(hung(picture, wood, 0.45, 0.35), "picture", (0.95, 1.75, -1.5)),
    }


def kitchen() -> Shapes:
    """A kitchen of 4.2 x 2.6 x 3.6 m: a worktop with sink and hob along the back, a table in the middle."""
    size = (4.2, 2.6, 3.6)
    paint = diffuse(rgb(0.8, 0.79, 0.74))
    yellow = diffuse(rgb(0.76, 0.6, 0.3))
    splash = rough_plastic(texture(bricks((0.8, 0.8, 0.77))), 0.1)
    floor = rough_plastic(texture(tiles([(0.5, 0.22, 0.13), (0.58, 0.3, 0.18), (0.46, 0.2, 0.13)], 6)), 0.25)
    green = rough_plastic(rgb(0.2, 0.32, 0.26), 0.2)
    wood = diffuse(texture(grain((0.55, 0.36, 0.2))))
    stone = rough_plastic(texture(terrazzo((0.22, 0.22, 0.23), [(0.5, 0.48, 0.45), (0.08, 0.08, 0.08)])))
    white, black = rough_plastic(rgb(0.8, 0.8, 0.78), 0.1), rough_plastic(rgb(0.03, 0.03, 0.035), 0.1)
    steel, copper, silver, crystal = metal(), metal("Cu", 0.15), mirror(), glass()
    pane = diffuse(rgb(*OVERCAST))
    gingham = diffuse(checks((0.65, 0.1, 0.1), (0.8, 0.76, 0.7), 8))
    red, leaf, crust = diffuse(rgb(0.6, 0.06, 0.04)), diffuse(rgb(0.12, 0.3, 0.08)), diffuse(rgb(0.5, 0.27, 0.1))
    picture = diffuse(texture(abstract()))
    fruit = [(0.07, 0.07, 0.03), (-0.06, 0.075, 0.05), (0, 0.075, -0.075), (0.01, 0.13, 0.0)]
    cups = [cup(white, (x, 0.35, 0.1)) for x in (-0.4, -0.22, -0.04)]
    jars = [jar(white, h, (x, 0, 0.1)) for x, h in ((-0.45, 0.16), (-0.31, 0.13), (-0.17, 0.18), (-0.03, 0.12))]
    dining = {
        **table(wood, 1.25, 0.8),
        "runner": boxes(gingham, ((0, 0.743, 0), (0.5, 0.006, 0.7)), tile=None),
        "bowl": transform(bowl(white, 0.17, 0.08), (-0.05, 0.746, 0)),
        "fruit": transform(join(*(ball(red, 0.045, at, subdivisions=3) for at in fruit)), (-0.05, 0.746, 0)),
        "jug": transform(jug(crystal), (0.38, 0.74, -0.15)),
        "cups": join(cup(white, (0.4, 0.74, 0.18)), cup(white, (-0.42, 0.74, -0.1))),
    }
    base = cupboard(green, green, steel, (1.8, 0.88, 0.6), 3)
    return {
        **room(size, floor, paint, [yellow, paint, splash, paint], floor_tile=1.8),
        **place(window(1.0, 0.85, paint, pane, SKY, (2, 2), leaf), "window", (-0.95, 1.62, -1.8)),
        **place(ceiling_light(0.9, 0.9, (8.6, 7.8, 6.7), paint), "ceiling_lamp", (-0.4, 2.6, -0.5)),
        "skirting": skirting(paint, size),
        **place(base, "base", (-1.2, 0, -1.5)),
        **place(cupboard(green, black, steel, (0.6, 0.88, 0.6), 1), "oven", (0, 0, -1.5)),
        **place(cupboard(green, green, steel, (1.1, 0.88, 0.6), 2, 3), "drawers", (0.85, 0, -1.5)),
        "worktop": boxes(stone, ((-0.35, 0.9, -1.49), (3.5, 0.04, 0.62))),
        "sink": transform(basket(white, (0.6, 0.14, 0.42)), (-0.95, 0.92, -1.47)),
        "sink_tap": transform(tap(steel, 0.34, 0.2), (-0.95, 0.92, -1.74)),
        **place(hob(black, steel), "hob", (0, 0.92, -1.48)),
        **place(pan(copper, black), "pan", (0.15, 0.93, -1.36), -50),
        **place(pot(steel, black), "pot", (-0.15, 0.93, -1.6)),
        "hood": transform(hood(steel, 0.98), (0, 1.62, -1.8)),
        **place(cupboard(green, green, steel, (1.0, 0.7, 0.33), 2, 1, 0), "wall_cupboard", (0.88, 1.5, -1.635)),
        **place(cupboard(white, white, steel, (0.68, 1.85, 0.64), 1, 2), "fridge", (1.75, 0, -1.47)),
        **place(kettle(steel, black), "kettle", (-1.75, 0.92, -1.45), -30),
        **place(toaster(steel, black), "toaster", (1.1, 0.92, -1.5)),
        "board": boxes(wood, ((0.62, 0.93, -1.45), (0.36, 0.02, 0.24))),
        "bread": rounded(crust, ((0.62, 0.99, -1.45), (0.26, 0.11, 0.12)), radius=0.055),
        "oil": join(bottle(crystal, 0.27, 0.033, (0.36, 0.92, -1.7))),
        **place(plant(red, leaf, 0.24, 0.1, 24, 3), "herbs", (-0.6, 1.125, -1.7)),
        "wall_shelf": transform(wall_shelf(wood, 1.1), (-2.1, 1.35, 0.2), 90),
        "crockery": transform(join(*jars, *cups), (-2.1, 1.35, 0.2), 90),
        **place(pot(copper, black, 0.09, 0.11), "casserole", (-2.0, 1.35, -0.15), 90),
        **place(dining, "table", (0.3, 0, 0.55)),
        **place(pendant(steel, yellow, (3.4, 2.6, 1.6), 0.62), "pendant", (0.3, 2.6, 0.55)),
        **place(chair(wood, gingham), "chair_1", (-0.7, 0, 0.5), 85),
        **place(chair(wood, gingham), "chair_2", (0.45, 0, 1.3), 175),
        **place(chair(wood, gingham), "chair_3", (0.15, 0, -0.2), 10),
        "mat": boxes(gingham, ((-0.95, 0.008, -0.8), (1.0, 0.016, 0.5)), tile=0.5),
        "bin": lathe(steel, [(0, 0), (0.15, 0), (0.16, 0.55), (0.13, 0.6), (0, 0.62)], (1.85, 0, -0.35)),
        **place(plant(crust, leaf, 0.95), "plant", (-1.7, 0, 1.4)),
        **place(stool(wood, 0.6), "stool", (1.7, 0, 1.45)),
        **place(door(wood, paint, steel), "door", (2.1, 0, 0.65), -90),
        **place(clock(white, black), "clock", (2.1, 1.9, -0.35), -90),
        **place(hung(silver, wood, 0.6, 0.8), "mirror", (0.4, 1.5, 1.8), 180),
        **place(hung(picture, wood, 0.5, 0.5), "picture", (-1.45, 1.55, 1.8), 180),
    }


def bedroom() -> Shapes:
    """A bedroom of 4.4 x 2.6 x 3.8 m: a bed with a bedside lamp that shines, a wardrobe, a chest of drawers."""
    size = (4.4, 2.6, 3.8)
    paint = diffuse(rgb(0.8, 0.79, 0.76))
    paper = diffuse(texture(sprigs((0.7, 0.72, 0.7), (0.25, 0.4, 0.25), (0.65, 0.25, 0.3))))
    lilac = diffuse(rgb(0.55, 0.5, 0.66))
    boards = rough_plastic(texture(planks((0.6, 0.46, 0.3), seed=4)), 0.25)
    wood = rough_plastic(texture(grain((0.32, 0.17, 0.09))), 0.2)
    linen = diffuse(rgb(0.82, 0.8, 0.76))
    cover = diffuse(texture(quilt([(0.3, 0.38, 0.6), (0.75, 0.72, 0.62), (0.6, 0.28, 0.3), (0.45, 0.55, 0.5)])))
    fabric = diffuse(texture(cloth((0.2, 0.4, 0.38))))
    rug = diffuse(texture(carpet([(0.6, 0.55, 0.45), (0.3, 0.4, 0.55), (0.5, 0.25, 0.3)])))
    weave = diffuse(texture(wicker((0.6, 0.42, 0.22))))
    rose = diffuse(rgb(0.65, 0.12, 0.15))
    fur, leaf = diffuse(rgb(0.42, 0.25, 0.12)), diffuse(rgb(0.1, 0.25, 0.07))
    glazed, black = rough_plastic(rgb(0.1, 0.2, 0.45), 0.1), rough_plastic(rgb(0.03, 0.03, 0.035))
    brass, silver, crystal = metal("Au", 0.2), mirror(), glass()
    pane = diffuse(rgb(*OVERCAST))
    picture = diffuse(texture(landscape()))
    bedside = cupboard(wood, wood, brass, (0.45, 0.5, 0.38), 1, 2)
    return {
        **room(size, boards, paint, [paper, lilac, paper, lilac]),
        **place(window(1.3, 1.1, paint, pane, SKY, (2, 2), leaf), "window", (-2.2, 1.5, 0.2), 90),
        **place(curtains(linen, brass, 1.45, 0.4, 2.2), "curtains", (-2.2, 2.35, 0.2), 90),
        **place(ceiling_light(0.9, 0.9, (8.8, 7.9, 6.8), paint), "ceiling_lamp", (0.1, 2.6, 0.1)),
        "skirting": skirting(paint, size),
        "radiator": transform(radiator(paint, 1.0, 0.45), (-2.2, 0, 0.2), 90),
        **place(door(paint, paint, brass), "door", (1.15, 0, 1.9), 180),
        **place(bed(wood, linen, cover), "bed", (-0.5, 0, -0.8)),
        **place(teddy(fur, black), "teddy", (-0.15, 0.57, -0.6), 25),
        **place(bedside, "bedside_1", (-1.68, 0, -1.68)),
        **place(table_lamp(glazed, linen, (4.2, 3.0, 1.7)), "lamp", (-1.68, 0.5, -1.68)),
        **place(bedside, "bedside_2", (0.66, 0, -1.68)),
        "books": transform(books(3, 2), (0.6, 0.5, -1.66), 20),
        "tumbler": tumbler(crystal, 0.13, 0.04, (0.79, 0.5, -1.6)),
        **place(cupboard(wood, wood, brass, (1.5, 2.1, 0.58), 3), "wardrobe", (1.9, 0, -0.85), -90),
        **place(cupboard(wood, wood, brass, (1.1, 0.82, 0.44), 2, 3), "chest", (-0.3, 0, 1.67), 180),
        **place(vase(crystal, 0.3), "vase", (-0.6, 0.82, 1.67)),
        **place(flowers(rose, leaf), "tulips", (-0.6, 0.84, 1.67)),
        "box": rounded(glazed, ((0.0, 0.87, 1.67), (0.22, 0.1, 0.15)), radius=0.02),
        **place(sofa(fabric, cover, 0.8, 0.75, 1), "armchair", (-1.5, 0, 1.05), 130),
        "rug": boxes(rug, ((0.95, 0.005, 0.6), (1.4, 0.01, 1.9)), tile=None),
        "pouf": rounded(fabric, ((0.75, 0.2, 0.75), (0.5, 0.4, 0.5)), radius=0.15),
        "basket": transform(basket(weave, (0.36, 0.3, 0.36)), (1.95, 0, 0.25)),
        **place(plant(glazed, leaf, 1.0), "plant", (1.85, 0, 1.5)),
        **place(hung(silver, wood, 0.55, 1.3), "mirror", (2.2, 1.25, 0.85), -90),
        **place(hung(picture, wood, 0.9, 0.6), "picture", (-0.5, 1.65, -1.9)),
        **place(clock(linen, black, 0.13), "clock", (-0.3, 1.8, 1.9), 180),
    }
