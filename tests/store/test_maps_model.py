"""Maps, versions, aliases and request ids against plain dictionaries."""

import tempfile
import uuid
from contextlib import suppress
from pathlib import Path

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from roel_service.errors import RoelError
from roel_service.store.builds import BuiltVersion
from roel_service.store.requests import RequestId
from roel_service.store.store import Store

from .samples import finalized, leased

MAPS = st.sampled_from(["attic", "house"])
ALIASES = st.sampled_from(["canary", "live"])
NUMBERS = st.integers(1, 3)
BUILT = BuiltVersion(rlm_bytes=b"map", line_count=3, bounds_m=[0.0] * 6, report={})


class MapsModel(RuleBasedStateMachine):
    """Every rule acts on both; what the store refuses, the model must refuse too."""

    def __init__(self):
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.store = Store(Path(self.folder.name))
        finalized(self.store)
        # For each map whether it is deleted, the states of its versions, and its aliases.
        self.maps = {}
        self.calls = []

    def teardown(self):
        self.store.__exit__(None, None, None)
        self.folder.cleanup()

    def alive(self, map_id):
        return map_id in self.maps and not self.maps[map_id]["deleted"]

    def attempt(self, allowed, change):
        """Make a change with a request id, provided that the model allows it."""
        request = RequestId(id=str(uuid.uuid4()), content_sha256="first")
        try:
            result = change(request)
        except RoelError:
            assert not allowed
            return False
        assert allowed
        self.calls.append((change, request, result))
        return True

    @rule(map_id=MAPS)
    def create(self, map_id):
        change = lambda request: self.store.maps.create(map_id, request=request)  # noqa: E731
        if self.attempt(map_id not in self.maps, change):
            self.maps[map_id] = {"deleted": False, "versions": [], "aliases": {}}

    @rule(map_id=MAPS)
    def delete(self, map_id):
        change = lambda request: self.store.maps.delete(map_id, "", request)  # noqa: E731
        if self.attempt(self.alive(map_id), change):
            self.maps[map_id]["deleted"] = True

    @rule(map_id=MAPS)
    def undelete(self, map_id):
        change = lambda request: self.store.maps.undelete(map_id, "", request)  # noqa: E731
        if self.attempt(map_id in self.maps and not self.alive(map_id), change):
            self.maps[map_id]["deleted"] = False

    @rule(map_id=MAPS)
    def purge(self, map_id):
        change = lambda request: self.store.maps.purge(map_id, "", request)  # noqa: E731
        if self.attempt(map_id in self.maps, change):
            del self.maps[map_id]

    @rule(map_id=MAPS, succeeds=st.booleans())
    def build(self, map_id, succeeds):
        if not self.alive(map_id):
            return
        operation = self.store.builds.begin(map_id, "walk")
        operations = self.store.operations
        if succeeds:
            operations.succeed(leased(self.store, operation), BUILT)
        else:
            operations.cancel(operation.id)
        self.maps[map_id]["versions"].append("active" if succeeds else "failed")

    @rule(map_id=MAPS, number=NUMBERS, alias=ALIASES)
    def promote(self, map_id, number, alias):
        active = self.alive(map_id) and self.state(map_id, number) == "active"
        promote = self.store.maps.promote
        change = lambda request: promote(map_id, number, alias, 9, request=request)  # noqa: E731
        if self.attempt(active, change):
            self.maps[map_id]["aliases"][alias] = number

    @rule(map_id=MAPS, number=NUMBERS)
    def delete_version(self, map_id, number):
        allowed = (
            self.alive(map_id)
            and self.state(map_id, number) in ("active", "failed")
            and number not in self.maps[map_id]["aliases"].values()
        )
        delete = self.store.maps.delete_version
        change = lambda request: delete(map_id, number, request)  # noqa: E731
        if self.attempt(allowed, change):
            self.maps[map_id]["versions"][number - 1] = "deleted"

    @rule(data=st.data())
    def repeat_a_call(self, data):
        if self.calls:
            change, request, result = data.draw(st.sampled_from(self.calls))
            assert change(request) == result

    @rule(data=st.data())
    def reuse_an_id(self, data):
        if self.calls:
            change, request, _ = data.draw(st.sampled_from(self.calls))
            with suppress(RoelError):
                change(RequestId(id=request.id, content_sha256="second"))
                raise AssertionError("an id that was used for another request")

    def state(self, map_id, number):
        versions = self.maps[map_id]["versions"]
        return versions[number - 1] if number <= len(versions) else "absent"

    @invariant()
    def the_store_says_what_the_model_says(self):
        listed = {item.id: item for item in self.store.maps.page("", 10, show_deleted=True)}
        assert set(listed) == set(self.maps)
        for map_id, expected in self.maps.items():
            record = listed[map_id]
            active = [n for n, state in enumerate(expected["versions"], 1) if state == "active"]
            latest = {"latest": max(active)} if active else {}
            assert record.is_deleted == expected["deleted"]
            assert record.aliases == {**expected["aliases"], **latest}
            if not expected["deleted"]:
                versions = self.store.maps.version_page(map_id, 0, 10)
                assert [item.state.value for item in versions] == expected["versions"]


MapsModel.TestCase.settings = settings(
    max_examples=8,
    stateful_step_count=20,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
test_maps_agree_with_dictionaries = MapsModel.TestCase
