from roel_service.scene.results import MAPPING_STAGES, TrackStatus


def test_every_status_has_its_own_name_on_the_wire():
    names = [status.value for status in TrackStatus]
    assert len(set(names)) == len(names)
    assert all(status.value == status.name.lower() for status in TrackStatus)


def test_stages_are_named_once():
    assert len(set(MAPPING_STAGES)) == len(MAPPING_STAGES)
