from sqlalchemy import MetaData, create_engine

from roel_service.store.migrations import migrate
from roel_service.store.schema import METADATA


def _columns(metadata):
    """What rows look like: for each table its columns, whether they may be null, and its key."""
    return {
        table.name: {
            (column.name, type(column.type.as_generic()), column.nullable, column.primary_key)
            for column in table.columns
        }
        for table in metadata.sorted_tables
    }


def test_the_migrations_make_the_tables_that_the_code_uses():
    engine = create_engine("sqlite://")
    with engine.begin() as connection:
        migrate(connection)
        migrated = MetaData()
        migrated.reflect(connection)
        assert _columns(migrated) == _columns(METADATA)


def test_migrating_twice_changes_nothing():
    engine = create_engine("sqlite://")
    with engine.begin() as connection:
        migrate(connection)
        migrate(connection)
        migrated = MetaData()
        migrated.reflect(connection)
        assert set(migrated.tables) == set(METADATA.tables)
