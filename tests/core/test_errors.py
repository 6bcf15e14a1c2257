"""Messages stay short and readable, whatever came."""

from __future__ import annotations

import copy
import pickle

import pytest

from cpdeform.core.errors import (
    MESSAGE_LENGTH,
    CapabilityError,
    EngineError,
    InputError,
    MissingExtraError,
    UnknownNameError,
    brief,
    nearest_name,
)


def raised(kind):
    if kind is InputError:
        return InputError("field", came="5", expected="a number", remedy="Give one.")
    if kind is UnknownNameError:
        return UnknownNameError("task", "stra", ["star"])
    if kind is MissingExtraError:
        return MissingExtraError("executor", "ray", module="ray", install='pip install "cpdeform[ray]"')
    return kind("no room")


@pytest.mark.parametrize("kind", [InputError, UnknownNameError, MissingExtraError, CapabilityError, EngineError])
def test_an_error_comes_back_from_another_process_as_it_was_raised(kind):
    error = raised(kind)
    for twin in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert type(twin) is kind
        assert (str(twin), twin.args, vars(twin)) == (str(error), error.args, vars(error))


@pytest.mark.parametrize("part", ["argument", "came", "expected", "remedy"])
def test_a_message_is_one_short_line(part):
    parts = {"argument": "field", "came": "5", "expected": "a number", "remedy": "Give one."}
    long = {**parts, part: "x" * 100_000}
    error = InputError(long.pop("argument"), **long)
    assert len(str(error)) <= MESSAGE_LENGTH
    kept = {name: text for name, text in parts.items() if name != part}
    assert all(text in str(error) for text in kept.values())


def test_all_parts_too_long_at_once():
    error = InputError("/a" * 5000 + "/end.npz", came="1\n" * 5000, expected="b" * 5000, remedy="r" * 5000)
    assert len(str(error)) <= MESSAGE_LENGTH
    assert "\n" not in str(error)
    assert "/end.npz" in str(error)
    assert "expected b" in str(error)


def test_brief():
    assert brief("a  b\n\tc", 20) == "a b c"
    assert brief("a\x1b[31m\ud800", 40) == "a\\x1b[31m\\ud800"
    assert brief("0123456789" * 3, 12) == "012345...789"


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("iteratons", "iterations"),
        ("lr", "learning_rate"),
        ("rate", "learning_rate"),
        ("width", "widths"),
        ("zzz", None),
        ("", None),
    ],
)
def test_the_name_that_was_meant(name, meant):
    assert nearest_name(name, ["iterations", "learning_rate", "patience", "widths"]) == meant


def test_a_long_list_of_names_leaves_room_for_the_one_that_was_meant():
    error = UnknownNameError("grid", "gird-17", [f"grid-{index}" for index in range(500)])
    assert 'Did you mean "grid-17"?' in str(error)
    assert len(str(error)) <= MESSAGE_LENGTH
