import errno
import sqlite3

import pytest
from sqlalchemy import create_engine
from sqlalchemy.exc import SQLAlchemyError

from roel_service.store.faults import store_failure


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_what_the_disk_refuses_can_be_tried_again(number):
    failure = store_failure(OSError(number, "what the disk says"))
    assert (failure.reason, failure.found) == ("STORE_UNAVAILABLE", "what the disk says")


def test_a_locked_database_can_be_tried_again(tmp_path):
    path = tmp_path / "rows.sqlite"
    engine = create_engine(f"sqlite:///{path}", connect_args={"timeout": 0.01})
    with sqlite3.connect(path, isolation_level=None) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(SQLAlchemyError) as caught, engine.connect() as connection:
            connection.exec_driver_sql("CREATE TABLE room (id INTEGER)")
        assert store_failure(caught.value).found == "database is locked"
    other.close()
    engine.dispose()


@pytest.mark.parametrize("error", [FileNotFoundError(errno.ENOENT, "gone"), ValueError("bug")])
def test_a_bug_is_no_failure_of_the_disk(error):
    assert store_failure(error) is None
