"""Messages of wrong settings: each is one line that names the file, the field and what the field must be."""

from typing import Literal

import pytest
from pydantic import Field, PositiveInt

from nlt.config import Settings, parse, read_configs
from nlt.errors import UserError
from nlt.paths import CONFIGS, find_config


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


def test_a_config_may_build_on_another(tmp_path):
    (tmp_path / "small.yaml").write_text("trainer: {max_steps: 6, precision: 32}\n")
    (tmp_path / "long.yaml").write_text("base: small\ntrainer: {max_steps: 60}\n")
    (tmp_path / "longer.yaml").write_text("base: long\nmodel: {width: 8}\n")
    merged = read_configs([tmp_path / "longer.yaml"])
    assert merged == {"trainer": {"max_steps": 60, "precision": 32}, "model": {"width": 8}}
    (tmp_path / "small.yaml").write_text("base: longer\n")
    with pytest.raises(UserError, match=r"small.yaml: base: longer builds on this config"):
        read_configs([tmp_path / "longer.yaml"])


@pytest.mark.parametrize("name", ["demo", "data/demo", "demo.yaml", "configs/data/demo", "configs/data/demo.yaml"])
def test_a_name_is_as_good_as_a_path(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_config("data", name) == CONFIGS / "data" / "demo.yaml"
    if "/" in name:
        assert find_config("", name) == CONFIGS / "data" / "demo.yaml"
    (tmp_path / "demo.yaml").touch()
    assert find_config("data", "demo.yaml").samefile(tmp_path / "demo.yaml")


@pytest.mark.parametrize(("name", "known"), [("data/nope", "demo_fixed_lights"), ("nope", "data/NAME")])
def test_an_unknown_name_is_answered_with_the_known_ones(name, known):
    with pytest.raises(UserError, match=rf"{name}.yaml: No such file; known are .*{known}"):
        read_configs([name])
