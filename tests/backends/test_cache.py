"""The cache: kept entries, files that are not entries, and deletions."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import stat
import time
from pathlib import Path

import pytest
from support.cache_folders import BLOCKED, blocked, contents, entries_in

from gpusense.backends import BackendInfo, cache, scratch
from gpusense.backends.cache import discard_entry, load_entry, pack, program_key, store_entry, unpack, write_files

INFO = BackendInfo("opencl:0:0", "opencl", "Some device", "gpu", "Driver 1", 1 << 30, 1 << 28, True)
needs_fifo = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs")


@pytest.fixture
def alarm():
    """End a test that blocks on a FIFO."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("the test waits"))
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def test_a_program_is_kept_and_found_again(place):
    assert load_entry("key") is None
    store_entry("key", b"binary")
    assert load_entry("key") == b"binary"
    assert [path.name for path in place.iterdir()] == [scratch.OWN]
    assert stat.S_IMODE((place / scratch.OWN).stat().st_mode) == 0o700
    assert sorted(path.suffix for path in (place / scratch.OWN).iterdir()) == [".TAG", ".gpusense"]


@pytest.mark.parametrize("other", ["source", "options", "driver", "device", "processor"])
def test_programs_are_keyed_by_device_driver_options_and_source(monkeypatch, other):
    base = dataclasses.replace(INFO, kind="cpu") if other == "processor" else INFO
    kept = program_key(base, "source", ["-a"])
    if other == "processor":
        monkeypatch.setattr(cache, "fingerprint", lambda: "another")
    info = {
        "driver": BackendInfo("opencl:0:0", "opencl", "Some device", "gpu", "Driver 2", 1, 1, True),
        "device": BackendInfo("opencl:0:0", "opencl", "Other device", "gpu", "Driver 1", 1, 1, True),
    }.get(other, base)
    source = "changed" if other == "source" else "source"
    assert program_key(info, source, ["-b" if other == "options" else "-a"]) != kept


@pytest.mark.parametrize("damage", [b"", b"short", b"gpusense entry 3\n" + bytes(64) + b"binary"])
def test_a_damaged_entry_is_none_and_is_written_again(place, damage):
    store_entry("source", b"binary")
    (entry,) = entries_in(place)
    entry.write_bytes(damage)
    assert load_entry("source") is None
    store_entry("source", b"binary")
    assert load_entry("source") == b"binary" and entries_in(place) == [entry]


def test_two_entries_that_were_exchanged_are_none(place):
    """Both are complete, and written by gpusense."""
    store_entry("first", b"one")
    store_entry("second", b"two")
    first, second = (place / scratch.OWN / cache._file(key) for key in ("first", "second"))
    first.rename(place / "away")
    second.rename(first)
    (place / "away").rename(second)
    assert load_entry("first") is load_entry("second") is None


def test_every_byte_of_an_entry_counts(place):
    store_entry("key", b"payload")
    (entry,) = entries_in(place)
    data = entry.read_bytes()
    for number in range(len(data)):
        changed = bytearray(data)
        changed[number] ^= 1 << number % 8
        entry.write_bytes(changed)
        assert load_entry("key") is None, number
    entry.write_bytes(data + b"\0")
    assert load_entry("key") is None
    entry.write_bytes(data)
    assert load_entry("key") == b"payload"


def make_fifo(path: Path, tmp_path: Path) -> None:
    os.mkfifo(path)


def make_device(path: Path, tmp_path: Path) -> None:
    try:
        # Reads without end.
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 5))
    except OSError:
        pytest.skip("this user cannot make a device")


def make_link(path: Path, tmp_path: Path) -> None:
    """Make a link to a complete entry of the key."""
    data = cache._head(cache._digest("key"), b"payload") + b"payload"
    (tmp_path / "target").write_bytes(data)
    path.symlink_to(tmp_path / "target")


def make_folder(path: Path, tmp_path: Path) -> None:
    path.mkdir()


@needs_fifo
@pytest.mark.parametrize("make", [make_fifo, make_device, make_link, make_folder])
def test_what_is_no_regular_file_is_no_entry_and_stays(place, tmp_path, caplog, alarm, make):
    store_entry("other", b"other")
    path = place / scratch.OWN / cache._file("key")
    make(path, tmp_path)
    before = contents(place)[f"{scratch.OWN}/{path.name}"]
    assert load_entry("key") is None
    discard_entry("key")
    store_entry("key", b"new")
    # The entry is in the folder for temporary files now.
    assert load_entry("key") == b"new" and contents(place)[f"{scratch.OWN}/{path.name}"] == before
    (message,) = caplog.messages
    assert f"the cache folder {place} cannot be written: " in message and "is no regular file" in message


def test_a_large_file_in_the_place_of_an_entry_is_not_read(place, monkeypatch):
    store_entry("key", b"payload")
    (entry,) = entries_in(place)
    os.truncate(entry, cache.MAX_ENTRY_BYTES + 1)
    monkeypatch.setattr(os, "fdopen", lambda *_: pytest.fail("it is opened"))
    assert load_entry("key") is None


def test_an_entry_that_is_too_large_is_not_kept(place, monkeypatch):
    monkeypatch.setattr(cache, "MAX_ENTRY_BYTES", 200)
    for size in (200, 100):
        store_entry("key", bytes(size))
    assert load_entry("key") == bytes(100)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")
def test_an_entry_of_another_user_is_none(place):
    store_entry("key", b"payload")
    (entry,) = entries_in(place)
    os.chown(entry, 65534, -1)
    assert load_entry("key") is None
    discard_entry("key")
    assert entry.exists()


def test_the_cache_is_bounded_and_evicts_the_oldest(place, monkeypatch):
    monkeypatch.setattr(cache, "MAX_ENTRIES", 3)
    for number in range(5):
        store_entry(f"source {number}", b"binary")
        for entry in entries_in(place):
            os.utime(entry, (entry.stat().st_atime, entry.stat().st_mtime - 10))
    assert [load_entry(f"source {number}") for number in range(5)] == [None, None, *[b"binary"] * 3]
    monkeypatch.setattr(cache, "MAX_BYTES", 200)
    store_entry("large", bytes(60))
    assert len(entries_in(place)) == 1


def foreign_files(folder: Path) -> list[Path]:
    """Make files that no cache wrote: other names, an entry's name without its head, the head of another key."""
    name = hashlib.sha256(b"x").hexdigest()
    head = cache._head(cache._digest("key"), b"payload") + b"payload"
    texts = {
        "notes.txt": b"mine", "notes.tmp": b"mine", "a.bin": head, "data.gpusense": head, f"{name}.bin": head,
        f"{name}.gpusense": b"mine", f"{hashlib.sha256(b'y').hexdigest()}.gpusense": head,
        f"{name}-abcdefgh.new": b"mine", f"{name}-abc.new": b"", "gpusense entry.new": b"",
    }  # fmt: skip
    for other, text in texts.items():
        (folder / other).write_bytes(text)
        os.utime(folder / other, (time.time() - 1e6,) * 2)
    (folder / f"{hashlib.sha256(b'z').hexdigest()}.gpusense").mkdir()
    return sorted(path for path in folder.iterdir() if path.name != scratch.MARKER)


def test_only_entries_are_evicted(place, monkeypatch):
    """Files of other programs stay, even in gpusense's folder, with any names and age."""
    scratch.own_folder(place)
    foreign = foreign_files(place / scratch.OWN)
    monkeypatch.setattr(cache, "MAX_ENTRIES", 1)
    for number in range(4):
        store_entry(f"entry {number}", b"payload")
        for path in entries_in(place):
            os.utime(path, (path.stat().st_mtime - 10,) * 2)
    left = sorted(path for path in (place / scratch.OWN).iterdir() if path.name != scratch.MARKER)
    assert set(foreign) <= set(left) and len(left) <= len(foreign) + 1


def test_unfinished_files_of_killed_processes_are_removed(place):
    store_entry("first", b"payload")
    names = [hashlib.sha256(text).hexdigest() for text in (b"1", b"2", b"3", b"4")]
    heads = [cache._head(bytes.fromhex(name), b"payload") for name in names]
    begun = [b"", heads[1][:20], heads[2] + b"pay", heads[3] + b"pay"]
    for turn, (name, text) in enumerate(zip(names, begun, strict=True)):
        path = place / scratch.OWN / f"{name}-abcd_123.new"
        path.write_bytes(text)
        os.utime(path, (time.time() - (7200 if turn < 3 else 0),) * 2)
    store_entry("second", b"payload")
    assert [path.name[:64] for path in (place / scratch.OWN).glob("*.new")] == [names[3]]


def test_the_cache_can_be_switched_off(place, monkeypatch):
    monkeypatch.setenv("GPUSENSE_CACHE", "off")
    store_entry("source", b"binary")
    assert not place.exists()
    assert load_entry("source") is None


def test_a_folder_that_is_removed_meanwhile_is_made_again(place):
    import shutil

    store_entry("key", b"payload")
    shutil.rmtree(place)
    assert load_entry("key") is None
    store_entry("key", b"payload")
    assert load_entry("key") == b"payload"


@pytest.mark.parametrize("how", BLOCKED)
def test_a_private_temporary_folder_takes_the_place_of_one_that_cannot_be_written(
    tmp_path, temporary, monkeypatch, caplog, how
):
    if how == "a read-only system" and not os.path.isdir("/proc/self"):
        pytest.skip("there is no /proc")
    place = blocked(tmp_path, how)
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(place))
    for number in range(3):
        store_entry(f"key {number}", b"payload")
    assert [load_entry(f"key {number}") for number in range(3)] == [b"payload"] * 3
    (folder,) = temporary.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and len(entries_in(folder)) == 3
    (message,) = caplog.messages
    assert message.startswith(f"gpusense: the cache folder {place} cannot be written: ")
    assert message.endswith("(the folder comes from GPUSENSE_CACHE_DIR)")


def test_without_a_home_the_cache_is_temporary(temporary, monkeypatch):
    for name in ("GPUSENSE_CACHE_DIR", "GPUSENSE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def no_home():
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", no_home)
    store_entry("key", b"payload")
    assert load_entry("key") == b"payload"
    assert len(list(temporary.rglob("*.gpusense"))) == 1


# ---- packed files


def test_files_are_packed_and_unpacked(tmp_path):
    files = {"a/b/program.bc": os.urandom(1000), "a/c.so": b"", "d": b"x" * 9}
    assert unpack(pack(files)) == files
    assert pack(files) == pack(dict(reversed(files.items())))
    write_files(tmp_path, files)
    assert {p.relative_to(tmp_path).as_posix(): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == files


@pytest.mark.parametrize("name", ["../out", "/etc/passwd", "a/../../out", "C:/out", "..\\out", "\\\\host\\out"])
def test_packed_files_stay_below_their_folder(name):
    with pytest.raises(ValueError, match="must hold paths below its folder"):
        unpack(pack({name: b""}))


def test_other_contents_are_no_packed_files(monkeypatch):
    """A change of any byte of packed files is detected, and the sizes in their heads are not trusted."""
    with pytest.raises(ValueError, match="must hold packed files"):
        unpack(b"something else")
    whole = pack({"a": b"some text" * 9, "b": b""})
    for place in range(len(whole)):
        for value in (0, 255):
            try:
                unpack(whole[:place] + bytes([value]) + whole[place + 1 :])
            except ValueError as error:
                assert str(error).startswith("entry: must hold ")
    monkeypatch.setattr(cache, "_MOST_BYTES", 1000)
    assert unpack(pack({"a": bytes(1000)})) == {"a": bytes(1000)}
    with pytest.raises(ValueError, match="must hold at most 1000 bytes of files"):
        unpack(pack({"a": bytes(600), "b": bytes(401)}))
