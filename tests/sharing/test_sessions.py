"""Sessions: replays against a set of all sequence numbers, and duplicate robot ids."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.transport_cases import Clock

from gmmtorch.team.sharing.transport.sessions import (
    FRESH_FRAMES,
    FRESH_SECONDS,
    MAX_SESSIONS,
    RETURNS,
    SILENCE,
    WINDOW,
    OwnIdWatch,
    ReplayWindow,
    Sessions,
)

A, B, C = b"A" * 8, b"B" * 8, b"C" * 8


@settings(max_examples=150)
@given(
    steps=st.lists(st.integers(-WINDOW - 2, WINDOW + 2) | st.integers(-3, 3) | st.just(1), max_size=60),
    start=st.sampled_from([0, 5, 2**31, 2**32 - 1]),
)
def test_a_window_accepts_each_sequence_number_once_and_none_below(steps, start):
    window, seen, number = ReplayWindow(), set(), start
    for step in [0, *steps]:
        number = min(max(number + step, 0), 2**32 - 1)
        is_new = number not in seen and (not seen or number > max(seen) - WINDOW)
        assert window.accept(number) == is_new
        assert not window.accept(number)
        seen.add(number)
        assert window.highest == max(seen)


def test_the_window_is_1024_wide():
    window = ReplayWindow()
    assert window.accept(5000)
    assert window.accept(5000 - 1023)
    assert not window.accept(5000 - 1024)


def test_a_restarted_robot_and_its_late_datagrams_are_accepted():
    sessions = Sessions(Clock())
    assert all(sessions.refusal(3, A, i) is None for i in (0, 1, 2, 4, 5))
    assert all(sessions.refusal(3, B, i) is None for i in range(3))
    assert sessions.refusal(3, A, 3) is None  # late
    assert sessions.refusal(3, A, 6) is None  # later still
    assert sessions.refusal(3, B, 3) is None
    assert sessions.refusal(3, A, 4) == "replayed"
    assert all(sessions.refusal(3, C, i) is None for i in range(100))  # another restart
    assert sessions.duplicates == {}


def test_late_datagrams_of_an_earlier_session_are_no_duplicate_robot_id():
    sessions = Sessions(Clock())
    assert sessions.refusal(3, A, 50) is None
    assert all(sessions.refusal(3, *spoken) is None for i in range(50) for spoken in ((B, i), (A, i)))
    assert sessions.duplicates == {}


def test_duplicate_robot_ids_are_refused_until_one_is_silent():
    clock = Clock()
    sessions = Sessions(clock)
    turns = [(A, 0, "a:1"), (B, 0, "b:2"), *((s, i, w) for i in (1, 2) for s, w in ((A, "a:1"), (B, "b:2")))]
    answers = [sessions.refusal(3, session, i, source) for session, i, source in turns]
    assert answers == [None] * (1 + RETURNS) + [
        "duplicate_id"
    ]  # each that came back after the first two: RETURNS
    assert sessions.duplicates == {3: "a:1 and b:2"}
    assert sessions.refusal(4, C, 0) is None  # other robots are accepted
    clock.now = SILENCE - 1
    assert sessions.refusal(3, B, 3) == "duplicate_id"
    clock.now = SILENCE
    assert sessions.refusal(3, B, 4) is None
    assert sessions.duplicates == {}
    for i in range(3, 8):  # A was only silent
        last = [sessions.refusal(3, A, i), sessions.refusal(3, B, 2 + i)]
    assert last == ["duplicate_id"] * 2


def test_the_memory_of_sessions_is_bounded():
    sessions = Sessions(Clock())
    for i in range(4 * MAX_SESSIONS):
        name = i.to_bytes(8, "little")
        sessions.refusal(i % 60000, name, i)
        sessions.refusal(7, name, 2 * i)
        sessions.refusal(7, A, 3 * i)
    assert len(sessions) == MAX_SESSIONS
    assert len(sessions._speakers) <= MAX_SESSIONS
    assert set(sessions.duplicates) <= set(sessions._speakers)


def test_the_session_silent_for_longest_is_forgotten_first():
    sessions = Sessions(Clock())

    def others_speak(n: int, tag: int) -> None:
        for i in range(n):
            assert sessions.refusal(2, bytes([tag]) + i.to_bytes(7, "little"), 0) is None

    assert sessions.refusal(1, A, 0) is None
    others_speak(MAX_SESSIONS - 1, 0)
    assert sessions.refusal(1, A, 0) == "replayed"
    assert sessions.refusal(1, A, 1) is None
    others_speak(MAX_SESSIONS - 1, 1)
    assert sessions.refusal(1, A, 0) == "replayed"
    others_speak(1, 2)
    assert sessions.refusal(1, A, 0) is None


# -- own robot id ------------------------------------------------------------------------------------


def found(frames: list[tuple[float, bytes, int]]) -> list[bool]:
    """Whether a watch detects a duplicate at each frame (time, session, sequence number)."""
    clock = Clock()
    watch, answers = OwnIdWatch(clock), []
    for clock.now, session, number in frames:
        answers.append(watch.detects(session, number))
    return answers


def test_old_datagrams_do_not_count_for_a_duplicate_robot_id():
    few = [(float(k), A, k) for k in range(FRESH_FRAMES - 1)]
    later = [(few[-1][0] + SILENCE + 1 + k, A, FRESH_FRAMES + k) for k in range(FRESH_FRAMES - 1)]
    assert not any(found(few + later))
    assert found([*few, *later, (later[-1][0] + FRESH_SECONDS, A, 100)])[-1]


def test_the_memory_of_a_watch_is_bounded():
    clock = Clock()
    watch = OwnIdWatch(clock)
    for k in range(3 * MAX_SESSIONS):
        assert not watch.detects(k.to_bytes(8, "little"), k)
    assert len(watch) == MAX_SESSIONS
