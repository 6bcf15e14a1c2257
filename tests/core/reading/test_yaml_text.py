"""YAML of unknown origin."""

from __future__ import annotations

import os
import time

import pytest

from cpdeform.core.errors import MESSAGE_LENGTH, InputError
from cpdeform.core.reading.limits import ReadingLimits
from cpdeform.core.reading.yaml_text import parse_yaml, read_yaml


def repeated(line: str, start: str) -> str:
    """Twelve lines, each of which repeats the one before nine times: 9^11 values."""
    lines = [f"a0: &a0 {start}"]
    lines += [f"a{index}: &a{index} {line % ', '.join([f'*a{index - 1}'] * 9)}" for index in range(1, 12)]
    return "\n".join(lines)


def test_values_are_those_of_yaml_1_2():
    text = "[1e3, 1.5e-3, 1_000, 007, 0x1f, -3, +5, .5, 1., -.inf, yes, ~, '5', 1:30, 2020-01-01, 1e, abc]"
    values = parse_yaml(text, argument="x")
    expected = [1000.0, 0.0015, 1000, 7, 31, -3, 5, 0.5, 1.0, float("-inf"), True, None, "5", "1:30", "2020-01-01", "1e", "abc"]
    assert values == expected
    assert [type(value) for value in values] == [type(value) for value in expected]


def test_anchors_and_merge_keys_of_a_sound_size_work():
    content = parse_yaml("a: &a {x: 1, y: [1, 2]}\nb: *a\nc: {<<: *a, x: 2}\n3: d", argument="x")
    assert content == {"a": {"x": 1, "y": [1, 2]}, "b": {"x": 1, "y": [1, 2]}, "c": {"x": 2, "y": [1, 2]}, 3: "d"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (repeated("[%s]", "[x]"), "more than 50000 values"),
        (repeated("{<<: [%s]}", "{k: 1}"), "more than 50000 values"),
        ("&a [*a]", "inside of what it stands for"),
        ("&a {x: {y: *a}}", "inside of what it stands for"),
        ("&a {<<: *a}", "inside of what it stands for"),
        ("[" * 500 + "]" * 500, "more than 50 deep"),
        ("{a: " * 500 + "1" + "}" * 500, "more than 50 deep"),
        ("- " * 20_000, "more than 50 deep"),
        ("a: &a " + "[" * 30 + "]" * 30 + "\nb: " + "[" * 30 + "*a" + "]" * 30, "more than 50 deep"),
        ("x" * 100_000, "100000 characters"),
        ("0x" + "f" * 5000, "whole number"),
        ("9" * 5000, "whole number"),
        ("!!python/object/apply:os.system [x]", "python/object"),
        ("!!binary aGVsbG8=", "binary"),
        ("!!set {a}", "set"),
        ("!!int text", "whole number"),
        ("!!bool text", "unreadable"),
        ("? [a]\n: 1", "unhashable"),
        ("1.5: x", "a key 1.5"),
        ("a: [", "malformed YAML"),
        ("--- a\n--- b", "malformed YAML"),
        ("\x00", "unreadable"),
        ("x" * 2**21, "2097152 characters"),
    ],
)
def test_refused_at_once_and_briefly(text, message):
    began = time.process_time()
    with pytest.raises(InputError, match=message) as caught:
        parse_yaml(text, argument="file.yaml")
    assert time.process_time() - began < 2.0
    assert str(caught.value).startswith("file.yaml: got ")
    assert len(str(caught.value)) <= MESSAGE_LENGTH


def test_limits_are_the_callers(tmp_path):
    text = "[" + ", ".join(["1"] * 60_000) + "]"
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match="50000 values"):
        read_yaml(tmp_path / "a.yaml", argument="a")
    assert len(read_yaml(tmp_path / "a.yaml", argument="a", limits=ReadingLimits(nodes=70_000))) == 60_000
    with pytest.raises(InputError, match="more than 1000 bytes"):
        read_yaml(tmp_path / "a.yaml", argument="a", limits=ReadingLimits(text_bytes=1000))


def test_what_is_no_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name, message in (
        ("pipe", "a named pipe"),
        ("zero", "a device"),
        (".", "a directory"),
        ("loop", "unreadable"),
        ("x\0", "null"),
    ):
        with pytest.raises(InputError, match=message):
            read_yaml(tmp_path / name, argument="file")
