"""Data models from content of unknown origin: pydantic's findings as one error that names the field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from cpdeform.core.errors import InputError, UnknownNameError, brief
from cpdeform.core.reading.boundary import boundary

Model = TypeVar("Model", bound=BaseModel)


def validate(model: type[Model], data: Any, *, source: str) -> Model:
    """Build a pydantic model; its errors become one `InputError` that names the field.

    Args:
        model: The model class.
        data: What to read it from.
        source: Where the data come from, for the message.

    Raises:
        InputError: The data do not fit the model.
    """
    with boundary(source, expected=f"the fields of {model.__name__}"):
        try:
            return model.model_validate(data)
        except ValidationError as error:
            raise field_error(model, error, source=source) from error


def field_error(model: type[BaseModel], error: ValidationError, *, source: str) -> InputError:
    """The error for the user: the first unknown field, since a missing one often is the same, misspelt; else the first error.

    Args:
        model: The model class that was to be built.
        error: What pydantic found.
        source: Where the data come from.
    """
    found = error.errors(include_url=False)
    first = next((item for item in found if item["type"] == "extra_forbidden"), found[0])
    field = ".".join(str(part) for part in first["loc"]) or "content"
    if first["type"] == "extra_forbidden":
        *path, name = first["loc"]
        return UnknownNameError(f"{source}: field {field}", str(name), _field_names(model, path))
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, InputError):
        parts = [str(part) for part in first["loc"]]
        place = ".".join(parts if parts and parts[-1] == cause.argument else [*parts, cause.argument])
        return InputError(f"{source}: {place}", came=cause.came, expected=cause.expected, remedy=cause.remedy)
    message = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if message.startswith(("greater", "less")):
        message = f"a value {message}"
    count = len(found) - 1
    more = f" ({count} more error{'s' if count > 1 else ''})" if count else ""
    return InputError(f"{source}: {field}", came=_came(first["input"]), expected=message[0].lower() + message[1:] + more)


def _came(value: Any) -> str:
    """What came, as short text; a value that cannot be shown is named by its type."""
    if isinstance(value, (Mapping, list, tuple, str, bytes)) and len(value) > 1000:
        return f"{type(value).__name__} of {len(value)}"
    try:
        return brief(repr(value), 120)
    except (ValueError, RecursionError):
        return f"a value of type {type(value).__name__}"


def _field_names(model: type[BaseModel], path: Sequence[int | str]) -> list[str]:
    """Names of the fields at a path of a validation error: field names, list indices, and tags that choose from a union."""
    models = {model}
    for part in path:
        if isinstance(part, int):
            continue
        annotations = [item.model_fields[part].annotation for item in models if part in item.model_fields]
        if annotations:
            models = set().union(*(_models_in(annotation) for annotation in annotations))
        else:
            models = {item for item in models if "kind" in item.model_fields and item.model_fields["kind"].default == part}
    return sorted({name for item in models for name in item.model_fields})


def _models_in(annotation: Any) -> set[type[BaseModel]]:
    """All models that a type annotation mentions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return set().union(*(_models_in(part) for part in get_args(annotation)))
