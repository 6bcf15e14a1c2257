"""YAML of unknown origin: task files and the values of `--set`, by the same rules.

The values are those of JSON: mappings, lists, texts, numbers, true and false, null. ``1e3`` is a number as in YAML 1.2 (PyYAML,
which is YAML 1.1, takes it for text), a date is a text.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.reading.boundary import boundary, read_text
from cpdeform.core.reading.limits import ReadingLimits

_TAGS = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
_FLOAT = re.compile(r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_INT = re.compile(r"[-+]?(0|[1-9][\d_]*|0b[01_]+|0x[0-9a-fA-F_]+|0o?[0-7_]+)")


def parse_yaml(text: str, *, argument: str, limits: ReadingLimits | None = None) -> Any:
    """Read a YAML text.

    Args:
        text: The text.
        argument: Where it comes from, for messages.
        limits: What is accepted.

    Returns:
        Mappings with texts or whole numbers as keys, lists, texts, numbers, truth values, None.

    Raises:
        InputError: It is no YAML, holds something else than such values, or more than the limits allow.
    """
    limits = limits or ReadingLimits()
    expected = "YAML"
    if len(text) > limits.text_bytes:
        raise InputError(argument, came=f"{len(text)} characters", expected=f"YAML of at most {limits.text_bytes}")
    with boundary(argument, expected=expected):
        # Imported on use: PyYAML is a tenth of the start-up time of commands that read no YAML.
        import yaml

        loader = _loader_class()(text, argument, limits)
        try:
            return loader.get_single_data()
        except yaml.MarkedYAMLError as error:
            place = f", line {error.problem_mark.line + 1}" if error.problem_mark is not None else ""
            raise InputError(argument, came=f"malformed YAML ({error.problem}{place})", expected=expected) from error
        except yaml.YAMLError as error:
            raise InputError(argument, came=f"malformed YAML ({error})", expected=expected) from error
        finally:
            loader.dispose()


def read_yaml(path: Path, *, argument: str, limits: ReadingLimits | None = None) -> Any:
    """Read a YAML file; see `parse_yaml`.

    Args:
        path: The file, UTF-8.
        argument: What it is, for messages.
        limits: What is accepted.

    Raises:
        InputError: It cannot be read, or as for `parse_yaml`.
    """
    limits = limits or ReadingLimits()
    text = read_text(path, argument=argument, expected=f"a YAML file of at most {limits.text_bytes} bytes", limit=limits.text_bytes)
    return parse_yaml(text, argument=argument, limits=limits)


@functools.cache
def _loader_class() -> Any:
    """The loader; a class of its own, so that its rules do not change `yaml.safe_load` for others."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Counts values while it composes them, before any mapping or list is built."""

        def __init__(self, text: str, argument: str, limits: ReadingLimits) -> None:
            super().__init__(text)
            self._argument, self._limits = argument, limits
            self._count = self._depth = self._deepest = 0
            self._sizes: dict[int, tuple[int, int]] = {}

        def compose_node(self, parent: Any, index: Any) -> Any:
            """Compose a value; an alias counts as much as what it repeats, inside and in depth."""
            before = self._count
            if self.check_event(yaml.AliasEvent):
                node = super().compose_node(parent, index)
                if id(node) not in self._sizes:
                    self._refuse("an alias inside of what it stands for")
                size, height = self._sizes[id(node)]
                self._charge(size, height)
                return node
            self._charge(1, 1)
            self._depth += 1
            deepest, self._deepest = self._deepest, self._depth
            node = super().compose_node(parent, index)
            self._sizes[id(node)] = (self._count - before, self._deepest - self._depth + 1)
            self._deepest = max(self._deepest, deepest)
            self._depth -= 1
            self._check(node)
            return node

        def _charge(self, count: int, height: int) -> None:
            self._count += count
            self._deepest = max(self._deepest, self._depth + height)
            if self._count > self._limits.nodes:
                self._refuse(f"more than {self._limits.nodes} values, repeated ones counted")
            if self._depth + height > self._limits.depth:
                self._refuse(f"lists and mappings more than {self._limits.depth} deep")

        def _check(self, node: Any) -> None:
            prefix, _, kind = node.tag.rpartition(":")
            if prefix != "tag:yaml.org,2002" or kind not in _TAGS:
                self._refuse(f"a value of kind {node.tag}")
            if isinstance(node, yaml.ScalarNode) and len(node.value) > self._limits.scalar_characters:
                self._refuse(f"a value of {len(node.value)} characters")

        def _refuse(self, came: str) -> None:
            raise InputError(self._argument, came=came, expected="mappings, lists, texts, numbers, true, false or null")

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            """Build a mapping; its keys are texts or whole numbers."""
            mapping = super().construct_mapping(node, deep=deep)
            for key in mapping:
                if not isinstance(key, (str, int)) or isinstance(key, bool):
                    self._refuse(f"a key {key!r}")
            return mapping

        def construct_yaml_int(self, node: Any) -> int:
            text = node.value.replace("_", "")
            if not _INT.fullmatch(node.value) or len(text) > 400:
                self._refuse(f'"{node.value}" for a whole number')
            digits = text.lstrip("+-")
            octal = len(digits) > 1 and digits[0] == "0" and digits.isdigit()
            return int(f"{text[: len(text) - len(digits)]}0o{digits}" if octal else text, 0)

        def construct_yaml_float(self, node: Any) -> float:
            if not _FLOAT.fullmatch(node.value):
                self._refuse(f'"{node.value}" for a number')
            return float(re.sub(r"\.(?=[in])", "", node.value.lower().replace("_", "")))

    Loader.yaml_implicit_resolvers = {
        sign: [(tag, pattern) for tag, pattern in pairs if tag.rpartition(":")[2] in ("null", "bool", "merge")]
        for sign, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_yaml_int)
    Loader.add_constructor("tag:yaml.org,2002:float", Loader.construct_yaml_float)
    Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(f"^(?:{_INT.pattern})$"), list("-+0123456789"))
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(f"^(?:{_FLOAT.pattern})$"), list("-+.0123456789"))
    return Loader
