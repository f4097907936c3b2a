"""What a JSON file holds, as a model. Every mistake names the file and the field."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from robotcell.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)


def validate(model: type[Model], values: Any, place: str) -> Model:
    """Values as a model.

    Raises:
        ConfigError: naming `place` and every wrong field.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = []
        for detail in error.errors():
            field = ".".join(str(part) for part in detail["loc"])
            message = detail["msg"].removeprefix("Value error, ")
            problems.append(f"{place}{': ' + field if field else ''}: {message}")
        raise ConfigError("\n  ".join(problems)) from error
