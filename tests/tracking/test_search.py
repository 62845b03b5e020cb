import pytest

from roel_service.tracking.search import SLICE_MS, Search


def slices_of(steps_ms):
    """The steps of each slice of a search that is nothing but these."""
    done = []

    class Steps(Search):
        def _searching(self, *_):
            for step_ms in steps_ms:
                yield step_ms
                done.append(step_ms)
            self.found = True

    search = Steps(*[None] * 7)
    slices = []
    while search.found is None:
        before = len(done)
        search.go_on()
        slices.append(done[before:])
    return slices


@pytest.mark.parametrize(
    ("steps_ms", "slices"),
    [
        (
            [SLICE_MS * share for share in (0.7, 0.5, 0.25, 0.25, 0.1)],
            [[SLICE_MS * share for share in part] for part in ([0.7], [0.5, 0.25, 0.25], [0.1])],
        ),
        # What is longer than a slice is one.
        ([5.0, 2.0 * SLICE_MS, 5.0], [[5.0], [2.0 * SLICE_MS], [5.0]]),
        ([SLICE_MS / 4] * 6, [[SLICE_MS / 4] * 4, [SLICE_MS / 4] * 2]),
    ],
)
def test_a_slice_is_as_many_steps_as_fit(steps_ms, slices):
    assert slices_of(steps_ms) == slices


def test_what_is_finished_leaves_nothing_to_do():
    class Steps(Search):
        def _searching(self, *_):
            yield from [SLICE_MS] * 5
            self.found = True

    search = Steps(*[None] * 7)
    search.go_on()
    assert search.found is None
    search.finish()
    assert search.found
