from dataclasses import dataclass

import numpy as np
import pytest

from roel_service.jobs.cache_place import CachePlace
from roel_service.jobs.preparations import Origin, Preparations


@dataclass(frozen=True)
class Parameters:
    scale: float = 1.0


def origin(name, scale=1.0):
    return Origin(kind="sample", sha256=name, parameters=Parameters(scale))


@dataclass(frozen=True)
class Sample:
    """A preparation of 800 bytes."""

    numbers: np.ndarray
    size_bytes: int = 800

    def to_arrays(self):
        return {"numbers": self.numbers}


class Maker:
    """Makes samples, and counts them."""

    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1
        return Sample(np.full(100, self.count, np.float64))


def read(arrays):
    return Sample(arrays["numbers"])


@pytest.fixture
def make():
    return Maker()


@pytest.fixture
def place(tmp_path):
    return CachePlace(folder=tmp_path, max_bytes=100_000)


def test_what_was_prepared_is_not_prepared_again(make):
    preparations = Preparations()
    first, second = (preparations.of(origin("a"), make, read, None) for _ in range(2))
    assert first is second
    assert make.count == 1


def test_other_files_and_other_parameters_are_other_preparations(make):
    preparations = Preparations()
    for wanted in (origin("a"), origin("b"), origin("a", scale=2.0)):
        preparations.of(wanted, make, read, None)
    assert make.count == 3


def test_what_was_not_used_for_the_longest_time_goes_first(make):
    preparations = Preparations(memory_bytes=2000)
    for name in ("a", "b", "a", "c", "a"):
        preparations.of(origin(name), make, read, None)
    assert make.count == 3
    preparations.of(origin("b"), make, read, None)
    assert make.count == 4


def test_more_than_fits_is_prepared_and_not_kept(make):
    preparations = Preparations(memory_bytes=100)
    found = [preparations.of(origin("a"), make, read, None).numbers[0] for _ in range(2)]
    assert found == [1.0, 2.0]


def test_another_process_finds_it_on_disk(make, place):
    kept = Preparations().of(origin("a"), make, read, place)
    found = Preparations().of(origin("a"), make, read, place)
    np.testing.assert_array_equal(found.numbers, kept.numbers)
    assert make.count == 1


def test_damage_on_disk_is_noticed(make, place):
    Preparations().of(origin("a"), make, read, place)
    (file,) = place.folder.iterdir()
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    Preparations().of(origin("a"), make, read, place)
    assert make.count == 2
