from roel_service.store.audit import Audit


def test_the_newest_entries_are_kept(store):
    audit = Audit(store._database, row_count=3)
    for number in range(5):
        audit.add(principal="robot-1", method="/s/Create", resource=f"maps/{number}", code="OK")
    newest = audit.newest(10)
    assert [entry.resource for entry in newest] == ["maps/4", "maps/3", "maps/2"]
    assert [entry.time_us for entry in newest] == sorted(
        (entry.time_us for entry in newest), reverse=True
    )
