import asyncio

import pytest

from roel_service.errors import UnimplementedError
from roel_service.service.methods import complete
from roel_service.service.services import SERVICES
from roel_service.v1 import maps_pb2


@pytest.fixture(scope="module")
def capabilities(client):
    return client.capabilities()


@pytest.fixture(scope="module")
def implemented(capabilities):
    return {method.name: method.implemented for method in capabilities.methods}


def test_every_limit_is_told(capabilities):
    limits = capabilities.limits
    told = {field.name: value for field, value in limits.ListFields()}
    assert set(told) == set(limits.DESCRIPTOR.fields_by_name)
    assert (limits.pose_count, limits.operation_retention_days) == (100, 30)


def test_formats_and_names_are_told(capabilities):
    assert "precise" in capabilities.presets
    assert list(capabilities.chunk_versions) == [1]
    assert capabilities.map_file_version == "1.0"
    assert "dxf" in capabilities.export_formats
    assert "edlines" in capabilities.detectors
    assert "xfeat" in capabilities.matchers


def test_every_service_is_listed_with_its_methods(implemented):
    assert {name.partition("/")[0] for name in implemented} == set(SERVICES)
    assert list(implemented) == sorted(implemented)
    assert implemented["roel_service.v1.MapService/GetMap"]


@pytest.fixture
def planned():
    """A service of which nobody wrote a method yet."""
    return complete(maps_pb2.DESCRIPTOR.services_by_name["MapService"], object())


def test_a_method_that_is_only_planned_says_so(planned):
    with pytest.raises(UnimplementedError, match="MapService/GetMap") as caught:
        asyncio.run(planned.GetMap(None, None))
    assert caught.value.reason == "METHOD_NOT_IMPLEMENTED"


def test_a_stream_that_is_only_planned_says_so(planned):
    with pytest.raises(UnimplementedError, match="MapService/ExportMap"):
        asyncio.run(anext(planned.ExportMap(None, None)))
