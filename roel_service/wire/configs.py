"""Configuration and its messages: one message for each table, every field optional."""

from __future__ import annotations

from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from roel_service.config.load import Tables, to_tables, with_tables
from roel_service.config.presets import preset
from roel_service.config.stages import Config
from roel_service.v1 import config_pb2


def config_to_proto(config: Config) -> config_pb2.MappingConfig:
    """Every field present."""
    return tables_to_proto(to_tables(config))


def config_from_proto(message: config_pb2.MappingConfig, preset_name: str = "default") -> Config:
    """The preset with the fields that are present.

    Raises:
        ConfigError: an unknown preset, or a value out of range.
    """
    return with_tables(preset(preset_name), tables_from_proto(message), subject="config")


def tables_to_proto(tables: Tables) -> config_pb2.MappingConfig:
    """Exactly the fields that checked tables name."""
    message = config_pb2.MappingConfig()
    for table, values in tables.items():
        part = getattr(message, table)
        part.SetInParent()
        for key, value in values.items():
            if isinstance(value, list):
                getattr(part, key).SetInParent()
                getattr(part, key).values.extend(value)
            else:
                setattr(part, key, value)
    return message


def tables_from_proto(message: config_pb2.MappingConfig) -> Tables:
    """The fields that are present, as the tables of a TOML file, in the order of that."""
    return {
        table.name: {
            field.name: _plain(field, getattr(part, field.name)) for field in _present(part)
        }
        for table in _present(message)
        for part in [getattr(message, table.name)]
    }


def _present(message: Any) -> list[FieldDescriptor]:
    """Fields that are set, as they are declared: their numbers tell when they came to be."""
    return [field for field in message.DESCRIPTOR.fields if message.HasField(field.name)]


def _plain(field: FieldDescriptor, value: Any) -> Any:
    """A list is a message of its own, so that an absent one differs from an empty one."""
    return list(value.values) if field.message_type else value
