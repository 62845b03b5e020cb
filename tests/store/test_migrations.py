from sqlalchemy import MetaData, create_engine

from roel_service.store.migrations import m001_first_tables, migrate
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


def test_operations_of_the_first_release_become_builds():
    engine = create_engine("sqlite://")
    with engine.begin() as connection:
        m001_first_tables.migrate(connection)
        connection.exec_driver_sql("PRAGMA user_version = 1")
        connection.exec_driver_sql("INSERT INTO map VALUES ('house', 2, 0)")
        for row in (
            "'ended', 'house', 1, 'walk', 'failed'",
            "'begun', 'house', 2, 'walk', 'queued'",
        ):
            end_time_us = 7 if "ended" in row else 0
            connection.exec_driver_sql(
                f"INSERT INTO operation VALUES ({row}, '', 0, 0, 0, x'65', 3, 5, {end_time_us})"
            )
        migrate(connection)
        columns = "id, method, version, error, expire_time_us"
        rows = connection.exec_driver_sql(f"SELECT {columns} FROM operation ORDER BY version")
        assert [tuple(row) for row in rows] == [
            ("ended", "BuildMap", 1, b"e", 7 + 30 * 24 * 3600 * 1_000_000),
            ("begun", "BuildMap", 2, b"e", 0),
        ]
