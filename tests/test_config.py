"""Messages of wrong settings: each is one line that names the file, the field and what the field must be."""

from typing import Literal

import pytest
from pydantic import Field, PositiveInt

from nlt.config import Settings, parse
from nlt.errors import UserError


class Lamp(Settings):
    power: PositiveInt = 3
    kind: Literal["point", "area"] = "point"


class Room(Settings):
    name: str
    lamps: dict[str, Lamp] = Field(default_factory=dict)
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    shelves: list[Lamp] = Field(default_factory=list)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "data.name: missing"),
        ({"nam": 1}, "data.nam: unknown key; known are name, lamps, size, shelves"),
        ({"name": 3}, "data.name: must be a text, is 3"),
        ({"name": "a", "lamps": {"lamp": {"power": 0}}}, "data.lamps.lamp.power: must be above 0, is 0"),
        (
            {"name": "a", "lamps": {"lamp": {"watt": 0}}},
            "data.lamps.lamp.watt: unknown key; known are power, kind",
        ),
        (
            {"name": "a", "lamps": {"lamp": {"power": True}}},
            "data.lamps.lamp.power: must be a whole number, is True",
        ),
        ({"name": "a", "size": [1, 2]}, "data.size.2: missing; the list is too short"),
        ({"name": "a", "shelves": [{"kind": "z"}]}, "data.shelves.0.kind: must be one of point, area, is 'z'"),
        ({"name": "a", "shelves": 3}, "data.shelves: must be a list, is 3"),
        (3, "data: must be a mapping, is 3"),
    ],
)
def test_one_line_says_what_is_wrong(content, message):
    with pytest.raises(UserError) as raised:
        parse(Room, content, "room.yaml", "data")
    assert str(raised.value) == f"room.yaml: {message}"


def test_lists_become_tuples_and_whole_numbers_floats():
    assert parse(Room, {"name": "a", "size": [1, 2, 3]}, "room.yaml").size == (1.0, 2.0, 3.0)
