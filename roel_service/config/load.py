"""Configuration from TOML and back, with strict keys and types."""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
from pathlib import Path
from typing import Any, get_type_hints

from roel_service.config.presets import preset
from roel_service.config.stages import Config
from roel_service.errors import ConfigError

Tables = dict[str, dict[str, Any]]


def load_config(
    preset_name: str, path: Path | None = None, overrides: Tables | None = None
) -> Config:
    """A preset, changed by a TOML file, changed by overrides such as command-line options.

    Raises:
        ConfigError: unknown preset, table or key, wrong type, value out of range, bad TOML.
    """
    config = preset(preset_name)
    if path is not None:
        config = with_tables(config, read_tables(path), subject=path.name)
    return with_tables(config, overrides or {}, subject="options")


def read_tables(path: Path) -> Tables:
    """The tables of a TOML file, not yet checked."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(path.name, "a readable TOML file", str(error)) from error


def with_tables(config: Config, tables: Tables, *, subject: str) -> Config:
    """`config` with the values that `tables` name; `subject` names their origin in errors."""
    stages = {item.name: getattr(config, item.name) for item in dataclasses.fields(config)}
    for table, values in tables.items():
        if table not in stages:
            raise _unknown(subject, table, list(stages), prefix="")
        if not isinstance(values, dict):
            raise ConfigError(subject, f"[{table}] as a table", f"{table} = {values!r}")
        stages[table] = _with_values(stages[table], table, values, subject)
    return Config(**stages)


def _with_values(stage: Any, table: str, values: dict[str, Any], subject: str) -> Any:
    types = get_type_hints(type(stage))
    names = [item.name for item in dataclasses.fields(stage)]
    changes = {}
    for key, value in values.items():
        if key not in names:
            raise _unknown(subject, key, names, prefix=f"{table}.")
        changes[key] = _typed(value, types[key], f"{table}.{key}", subject)
    try:
        return dataclasses.replace(stage, **changes)
    except ConfigError as error:
        raise ConfigError(subject, f"{error.subject} {error.expected}", error.found) from None


def _unknown(subject: str, key: str, known: list[str], *, prefix: str) -> ConfigError:
    near = difflib.get_close_matches(key, known, n=1)
    choice = ", ".join(prefix + name for name in (near or known))
    return ConfigError(subject, f"one of {choice}", prefix + key)


def _typed(value: Any, expected: Any, path: str, subject: str) -> Any:
    """`value` as the type of its field; integers pass as floats, lists as tuples."""
    inner = {"tuple[float, ...]": float, "tuple[int, ...]": int, "tuple[str, ...]": str}
    item_type = inner.get(str(expected))
    if item_type is not None:
        if not isinstance(value, list | tuple):
            raise ConfigError(subject, f"{path} as a list", repr(value))
        return tuple(_typed(item, item_type, path, subject) for item in value)
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not expected:
        raise ConfigError(subject, f"{path} of type {expected.__name__}", repr(value))
    return value


def to_tables(config: Config) -> Tables:
    """Every effective value, as plain tables of lists, numbers, strings and booleans."""
    return {
        table: {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}
        for table, values in dataclasses.asdict(config).items()
    }


def to_toml(config: Config) -> str:
    """TOML text that `load_config` reads back to an equal configuration."""
    blocks = []
    for table, values in to_tables(config).items():
        lines = [f"{key} = {_toml_value(value)}" for key, value in values.items()]
        blocks.append("\n".join([f"[{table}]", *lines]))
    return "\n\n".join(blocks) + "\n"


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON escapes quotes and backslashes as TOML does; other characters stay as they are.
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    return repr(value)
