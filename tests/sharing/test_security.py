"""Sealed datagrams against direct use of the library, hostile frames, replays and duplicate robot ids."""

from __future__ import annotations

import copy
import logging
import os
import pickle
import sys
import threading

import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.transport_cases import KEY, SECRET, Clock

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.team.sharing.transport.security import (
    FRESH_FRAMES,
    FRESH_SECONDS,
    MAX_SESSIONS,
    PLAIN_OVERHEAD,
    REFUSALS,
    RETURNS,
    SEALED_OVERHEAD,
    SILENCE,
    WINDOW,
    Opener,
    OwnIdWatch,
    ReplayWindow,
    Sealer,
    Sessions,
    TeamKey,
)

datagrams = st.binary(max_size=1200)


def refused(opener: Opener) -> dict[str, int]:
    return {reason: n for reason, n in opener.refused.items() if n}


# -- keys ------------------------------------------------------------------------------------------------


def test_a_key_of_openssl_is_read(tmp_path, monkeypatch):
    path = tmp_path / "team.key"
    path.write_text(SECRET.hex() + "\n")
    path.chmod(0o400)
    assert TeamKey.from_file(path)._data == SECRET
    monkeypatch.setenv("GMMTORCH_TEAM_KEY", SECRET.hex().upper())
    assert TeamKey.from_environment()._data == SECRET


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o660, 0o602])
def test_key_files_readable_by_others_are_refused(tmp_path, mode):
    path = tmp_path / "team.key"
    path.write_text(SECRET.hex())
    path.chmod(mode)
    with pytest.raises(DataError, match=f"mode {mode:o}.*chmod 600 .*team.key"):
        TeamKey.from_file(path)


def test_invalid_keys_are_refused_without_showing_them(tmp_path, monkeypatch):
    digits, path, messages = SECRET.hex(), tmp_path / "team.key", []

    def error_of(kind, make):
        with pytest.raises(kind) as caught:
            make()
        error = caught.value
        while error is not None:  # also its causes
            messages.append(str(error) + repr(error))
            error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
        return str(caught.value)

    for text, what in [
        (digits[:-1], "63 characters"),
        (digits + "00", "66 characters"),
        ("", "0 characters"),
        (digits[:-1] + "x", "hexadecimal"),
        (digits[:-1] + "é", "65 characters"),
        (digits[:-2] + "é", "hexadecimal"),
        (digits * 1000, "1024 characters"),
    ]:
        path.write_bytes(text.encode())
        path.chmod(0o600)
        message = error_of(DataError, lambda: TeamKey.from_file(path))
        assert what in message
        assert str(path) in message
        assert "openssl rand -hex 32" in message
    monkeypatch.setenv("GMMTORCH_TEAM_KEY", digits[:-2])
    assert "$GMMTORCH_TEAM_KEY has 62" in error_of(DataError, TeamKey.from_environment)
    monkeypatch.delenv("GMMTORCH_TEAM_KEY")
    assert "$GMMTORCH_TEAM_KEY is not set" in error_of(MissingDataError, TeamKey.from_environment)
    absent = tmp_path / "absent"
    assert f"{absent} does not exist" in error_of(MissingDataError, lambda: TeamKey.from_file(absent))
    assert "is no file" in error_of(MissingDataError, lambda: TeamKey.from_file(tmp_path))
    assert "31 bytes" in error_of(InvalidArgumentError, lambda: TeamKey(SECRET[:31]))
    assert "33 bytes" in error_of(InvalidArgumentError, lambda: TeamKey(SECRET + b"!"))
    assert "str" in error_of(InvalidArgumentError, lambda: TeamKey(digits))
    error_of(InvalidArgumentError, lambda: pickle.dumps(KEY))
    error_of(InvalidArgumentError, lambda: copy.deepcopy(KEY))
    shown = [*messages, repr(KEY), str(KEY), f"{KEY}", f"{[KEY]}", "%r" % KEY]  # noqa: UP031
    assert not any(digits[:8] in text or repr(SECRET)[2:20] in text for text in shown)


def test_a_missing_package_is_reported_with_its_extra(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "cryptography"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(GmmTorchError, match=r"pip install 'gmmtorch\[network\]'"):
        Sealer(0, KEY)
    assert Opener().open(Sealer(0).seal(b"plain")) == (0, b"plain")  # plain frames need no package


# -- frames ----------------------------------------------------------------------------------------------


@given(datagram=datagrams, sender=st.integers(0, 65535))
def test_a_frame_equals_direct_use_of_the_library(datagram, sender):
    """Byte by byte as in docs/network.md."""
    sealer, aead = Sealer(sender, KEY), ChaCha20Poly1305(SECRET)
    for number in range(3):
        frame = sealer.seal(datagram)
        header = b"\xf1" + sender.to_bytes(2, "little") + sealer.session + number.to_bytes(4, "little")
        assert frame[:15] == header
        assert frame[15:] == aead.encrypt(header[3:], datagram, header)
        assert len(frame) == len(datagram) + SEALED_OVERHEAD == len(datagram) + 31
    header = b"\xf1" + sender.to_bytes(2, "little") + b"sessions" + b"\1\2\3\4"
    assert Opener(KEY).open(header + aead.encrypt(header[3:], datagram, header)) == (sender, datagram)


@given(datagram=datagrams)
def test_an_unsealed_frame_is_a_header_and_the_datagram(datagram):
    sealer = Sealer(300)
    frames = [sealer.seal(datagram) for _ in range(2)]
    assert frames == [b"\xe1\x2c\x01" + sealer.session + bytes([i, 0, 0, 0]) + datagram for i in range(2)]
    assert len(frames[0]) == len(datagram) + PLAIN_OVERHEAD == len(datagram) + 15
    assert [Opener().open(frame) for frame in frames] == [(300, datagram)] * 2


def test_the_longest_frame_fits_every_path_of_ipv6():
    assert len(Sealer(0, KEY).seal(bytes(1200))) + 40 + 8 <= 1280


def test_nonces_are_unique():
    sealers = [Sealer(1, KEY), Sealer(1, KEY), Sealer(2, KEY)]
    nonces = [sealer.seal(b"same")[3:15] for sealer in sealers for _ in range(100)]
    sealers[0]._number = 2**32 - 1
    nonces += [
        sealers[0].seal(b"same")[3:15] for _ in range(3)
    ]  # the last sequence number, then another session
    assert nonces[-3].endswith(b"\xff" * 4)
    assert nonces[-2].endswith(b"\0" * 4)
    found: list[bytes] = []
    threads = [
        threading.Thread(target=lambda: found.extend([sealers[1].seal(b"")[3:15] for _ in range(2000)]))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    nonces += found
    assert len(nonces) == 8303
    assert len(set(nonces)) == len(nonces)
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(InvalidArgumentError, match="nonces"):
            copied(sealers[0])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_uses_other_nonces():
    sealer = Sealer(1, KEY)
    sealer.seal(b"before")
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writing, sealer.seal(b"child"))
        os._exit(0)
    os.waitpid(child, 0)
    frames = [os.read(reading, 2000), sealer.seal(b"parent")]
    os.close(reading)
    os.close(writing)
    assert frames[0][3:11] != frames[1][3:11]
    assert [Opener(KEY).open(frame) for frame in frames] == [(1, b"child"), (1, b"parent")]


@pytest.mark.parametrize(
    ("arguments", "message"), [((-1,), "sender=-1"), ((65536,), "sender=65536"), ((1.5,), "sender=1.5")]
)
def test_invalid_senders_are_refused(arguments, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Sealer(*arguments, KEY)


# -- hostile frames --------------------------------------------------------------------------------------


def test_every_cut_flipped_bit_and_added_byte_is_refused():
    opener, frame = Opener(KEY), Sealer(9, KEY).seal(b"the plan of the ninth robot")
    n = 0
    for length in range(len(frame)):
        assert opener.open(frame[:length]) is None
        n += 1
    for bit in range(8 * len(frame)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        assert opener.open(bytes(damaged)) is None
        n += 1
    assert opener.open(frame + b"\0") is None
    assert sum(opener.refused.values()) == n + 1
    assert opener.open(frame) == (9, b"the plan of the ninth robot")  # the valid frame is still accepted


@settings(max_examples=200)
@given(data=st.binary(max_size=1400), key=st.sampled_from([KEY, None]))
def test_noise_is_refused_and_counted(data, key):
    opener = Opener(key)
    opened = opener.open(data)
    assert (opened is None) == (sum(opener.refused.values()) == 1)
    assert opened is None or (key is None and opened[1] == data[15:])


@settings(max_examples=200)
@given(header=st.binary(min_size=14, max_size=14), data=st.binary(max_size=1300))
def test_noise_with_a_valid_header_is_refused_without_state(header, data):
    opener = Opener(KEY)
    assert opener.open(b"\xf1" + header + data) is None
    reason = "oversized" if len(data) > 1216 else "malformed" if len(data) < 16 else "wrong_key"
    assert refused(opener) == {reason: 1}
    assert len(opener._sessions._windows) == 0


def test_each_rejection_reason_is_counted_separately():
    other = TeamKey.generate()
    sealer = Sealer(1, KEY)
    frame = Sealer(2, KEY).seal(b"again")
    for reason, frames in {
        "oversized": [bytes(1232), b"\xe1" + bytes(1215), bytes(65000)],
        "foreign": [b"", b"\x11" + bytes(100), b"\x41", b"GET / HTTP/1.1"],
        "version": [b"\xf2" + bytes(100), b"\xe0", b"\xff"],
        "malformed": [b"\xf1", b"\xf1" + bytes(29), b"\xe1" + bytes(13)],
        "wrong_key": [b"\xf1" + bytes(30), Sealer(3, other).seal(b"x"), Sealer(3).seal(b"x")],
        "echo": [sealer.seal(b"x"), sealer.seal(b"x")],
        "replayed": [frame, frame],
        "duplicate_id": [Sealer(1, KEY).seal(b"x")],
    }.items():
        opener = Opener(KEY, own=sealer)
        for each in [Sealer(2, KEY).seal(b"x"), *([frame] if reason == "replayed" else [])]:
            assert opener.open(each) is not None
        assert [opener.open(each) for each in frames] == [None] * len(frames), reason
        assert refused(opener) == {reason: len(frames)}
        assert tuple(opener.refused) == REFUSALS
    assert [Opener().open(each) for each in (Sealer(3, KEY).seal(b"x"), b"\xf1" + bytes(60))] == [None] * 2


def test_a_wrong_key_is_logged_once(caplog):
    other, opener = Sealer(3, TeamKey.generate()), Opener(KEY)
    with caplog.at_level(logging.DEBUG):
        for _ in range(100):
            opener.open(other.seal(b"x"), "10.0.0.5:7447")
    (message,) = caplog.messages
    assert "10.0.0.5:7447" in message
    assert "robot 3" in message
    assert "same team key" in message
    with caplog.at_level(logging.DEBUG):
        for sender in range(2000):
            opener.open(b"\xf1" + sender.to_bytes(2, "little") + bytes(40))
    assert len(caplog.messages) == 16
    assert opener.refused["wrong_key"] == 2100


def test_duplicate_robot_ids_are_reported_and_refused(caplog):
    first, second, opener = Sealer(3, KEY), Sealer(3, KEY), Opener(KEY, own=Sealer(4, KEY))
    heard = []
    for _ in range(10):
        heard += [opener.open(first.seal(b"1"), "10.0.0.5:1"), opener.open(second.seal(b"2"), "10.0.0.6:1")]
    assert heard[:2] == [(3, b"1"), (3, b"2")]
    assert heard[6:] == [None] * 14
    assert set(opener.duplicates) == {3}
    (message,) = caplog.messages
    assert "the id 3" in message
    assert "10.0.0.5:1" in message
    assert "10.0.0.6:1" in message


def test_a_robot_with_this_robots_id_is_reported(caplog):
    clock = Clock()
    own, other = Sealer(3, KEY), Sealer(3, KEY)
    opener = Opener(KEY, own=own, clock=clock)
    both = f"10.0.0.6:1 (session {other.session.hex()}) and this robot (session {own.session.hex()})"
    for n in range(1, 8):
        assert opener.open(other.seal(b"x"), "10.0.0.6:1") is None
        assert refused(opener) == {"duplicate_id": n}
        assert opener.duplicates == ({} if n < 6 else {3: both})
        assert len(caplog.messages) == (n >= 6)
        clock.now += 1.0
    assert both in caplog.text


def test_replayed_sessions_of_this_robot_are_refused(caplog):
    """Frames of earlier sessions, replayed repeatedly, late and interleaved."""
    clock = Clock()
    lives = [[life.seal(b"before") for _ in range(40)] for life in (Sealer(3, KEY), Sealer(3, KEY))]
    own = Sealer(3, KEY)
    opener = Opener(KEY, own=own, clock=clock)
    played = [frame for pair in zip(*lives, strict=True) for frame in pair]
    for clock.now in [0.0, 4.9, *range(10, 50)]:
        for frame in played:
            assert opener.open(frame, "10.0.0.6:1") is None
    n = 42 * len(played)
    assert opener.open(Sealer(4, KEY).seal(b"x")) == (4, b"x")
    assert opener.open(own.seal(b"mine")) is None
    assert refused(opener) == {"duplicate_id": n, "echo": 1}
    assert (opener.duplicates, caplog.messages) == ({}, [])


def test_earlier_sessions_are_no_duplicate_robot_id(caplog):
    clock = Clock()
    before, other = Sealer(3, KEY), Sealer(3, KEY)
    opener = Opener(KEY, own=Sealer(3, KEY), clock=clock)
    opener.former = frozenset({before.session})
    for n in range(1, 60):
        clock.now += 1.0
        assert opener.open(before.seal(b"played back in its order"), "10.0.0.6:1") is None
        assert (opener.duplicates, refused(opener)) == ({}, {"duplicate_id": n})
    for _ in range(8):
        clock.now += 1.0
        assert opener.open(other.seal(b"x"), "10.0.0.6:1") is None
    assert list(opener.duplicates) == [3]
    assert len(caplog.messages) == 1


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
    assert len(sessions._windows) == MAX_SESSIONS
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
    assert len(watch._sessions) == MAX_SESSIONS
