import threading

from roel_service.store.locks import KeyedLocks


def test_one_key_is_held_by_one_at_a_time_and_others_by_others():
    locks = KeyedLocks()
    entered = threading.Event()

    def enter():
        with locks.holding("a"):
            entered.set()

    waiting = threading.Thread(target=enter)
    with locks.holding("a"):
        with locks.holding("b"):
            waiting.start()
        assert not entered.wait(0.05)
    waiting.join()
    assert entered.is_set()
