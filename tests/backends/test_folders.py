"""The folders of code: owners, permissions, and the folders of gpusense."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.cache_folders import blocked, contents, entries_in

from gpusense._util import private
from gpusense._util.private import UnsafeFolderError, check_private, read_regular
from gpusense.backends import scratch
from gpusense.backends.cache import load_entry, store_entry

as_root = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give folders away")
with_owners = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="folders have no owners here")
NOBODY = 65534


def give_away(folder: Path) -> None:
    os.chown(folder, NOBODY, -1)


RULES = {
    "owner": (give_away, "must be owned by this user (0), got owner 65534"),
    "group": (lambda folder: folder.chmod(0o770), "must be writable by its owner only (mode 0700), got mode 0770"),
    "others": (lambda folder: folder.chmod(0o702), "must be writable by its owner only (mode 0700), got mode 0702"),
}
PARENT_RULES = {
    "owner": (give_away, "which holds gpusense-kernels, must be owned by this user (0) or root, got owner 65534"),
    "others": (lambda folder: folder.chmod(0o777), "must not be writable by others unless it is sticky, got mode 0777"),
}


def poison(key: str) -> None:
    """Write an entry, and forget the check of its folder."""
    store_entry(key, b"code")
    assert load_entry(key) == b"code"
    scratch._checked.clear()


@as_root
@pytest.mark.parametrize("variable", ["GPUSENSE_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "TMPDIR"])
@pytest.mark.parametrize("where", ["own", "parent"])
def test_no_code_is_read_from_a_folder_that_others_can_change(
    tmp_path, temporary, monkeypatch, caplog, variable, where
):
    """The message names the folder, the rule, and the variable that chose the folder."""
    for name in ("GPUSENSE_CACHE_DIR", "XDG_CACHE_HOME", "GPUSENSE_CACHE"):
        monkeypatch.delenv(name, raising=False)
    place = {
        "GPUSENSE_CACHE_DIR": tmp_path / "chosen", "XDG_CACHE_HOME": tmp_path / "chosen" / "gpusense",
        "HOME": tmp_path / "chosen" / ".cache" / "gpusense", "TMPDIR": temporary / f"gpusense-{os.geteuid()}",
    }[variable]  # fmt: skip
    if variable == "TMPDIR":
        monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(blocked(tmp_path, "a file in its place")))
    else:
        monkeypatch.setenv(variable, str(tmp_path / "chosen"))
    for rule, (change, text) in (RULES if where == "own" else PARENT_RULES).items():
        poison(f"{variable} {rule}")
        folder = place / scratch.OWN if where == "own" else place
        change(folder)
        caplog.clear()
        scratch._reported.clear()
        assert load_entry(f"{variable} {rule}") is None
        store_entry(f"{variable} {rule}", b"new")
        messages = [message for message in caplog.messages if "is not used" in message]
        assert messages == [f"gpusense: the cache folder {place} is not used: {messages[0].split('is not used: ')[1]}"]
        assert str(folder) in messages[0] and text in messages[0]
        assert messages[0].endswith(f"(the folder comes from {variable})")
        os.chown(folder, 0, -1)
        folder.chmod(0o700)
        scratch._checked.clear()
        # Nothing was written to a refused folder.
        assert load_entry(f"{variable} {rule}") == b"code"
        for path in [*entries_in(place), *temporary.rglob("*.gpusense")]:
            path.unlink(missing_ok=True)


@with_owners
def test_nothing_is_made_where_others_could_replace_it(place, temporary):
    place.mkdir()
    place.chmod(0o777)
    store_entry("key", b"code")
    assert contents(place) == {} and len(entries_in(temporary / f"gpusense-{os.geteuid()}")) == 1


@with_owners
def test_a_link_is_no_folder_of_gpusense(tmp_path, place, caplog):
    store_entry("key", b"code")
    (place / scratch.OWN).rename(tmp_path / "elsewhere")
    (place / scratch.OWN).symlink_to(tmp_path / "elsewhere")
    scratch._checked.clear()
    assert load_entry("key") is None
    assert "must be a real directory, got a symbolic link" in caplog.messages[0]


@with_owners
def test_a_place_may_be_a_link(tmp_path, place):
    """Users put their caches on other disks."""
    (tmp_path / "disk").mkdir()
    place.symlink_to(tmp_path / "disk")
    store_entry("key", b"code")
    assert load_entry("key") == b"code" and len(entries_in(tmp_path / "disk")) == 1


@with_owners
@pytest.mark.parametrize("umask", [0o000, 0o002, 0o077])
def test_folders_are_made_for_this_user_alone_whatever_the_umask(tmp_path, umask):
    before = os.umask(umask)
    try:
        folder = scratch.own_folder(tmp_path / "a" / "b" / "c")
    finally:
        os.umask(before)
    check_private(folder)
    for path in (folder, folder.parent, tmp_path / "a" / "b", tmp_path / "a"):
        assert path.stat().st_mode & 0o077 == 0


@with_owners
def test_a_sticky_folder_and_the_group_of_one_user_are_safe_above(tmp_path, monkeypatch):
    folder = scratch.own_folder(tmp_path / "cache")
    folder.parent.chmod(0o1777)
    check_private(folder)
    folder.parent.chmod(0o770)
    monkeypatch.setattr(private, "_is_group_of_one", lambda group: True)
    check_private(folder)
    monkeypatch.setattr(private, "_is_group_of_one", lambda group: False)
    with pytest.raises(UnsafeFolderError, match="must not be writable by others unless it is sticky, got mode 0770"):
        check_private(folder)


@with_owners
def test_the_group_of_one_user_has_the_users_name_and_no_other_member(monkeypatch):
    import grp
    import pwd

    user = pwd.struct_passwd(("me", "x", 5000, 6000, "", "/", "/bin/sh"))
    monkeypatch.setattr(pwd, "getpwuid", lambda number: user)
    for name, members, number, expected in (
        ("me", [], 6000, True), ("me", ["me"], 6000, True), ("me", ["me", "you"], 6000, False),
        ("staff", [], 6000, False), ("me", [], 6001, False),
    ):  # fmt: skip
        found = grp.struct_group((name, "x", number, members))
        monkeypatch.setattr(grp, "getgrgid", lambda number, found=found: found)
        assert private._is_group_of_one(number) is expected
    assert private._is_group_of_one(0)


@with_owners
def test_the_owners_outside_of_a_user_namespace_are_trusted(monkeypatch):
    """Such an owner is the machine's root; a user of that number within the namespace is not trusted."""
    import builtins
    import io

    real = open
    maps = {"uid_map": "0 1000 1\n", "overflowuid": "65534\n"}

    def fake(path, *arguments, **options):
        text = maps.get(str(path).rsplit("/", 1)[-1])
        return real(path, *arguments, **options) if text is None else io.StringIO(text)

    monkeypatch.setattr(builtins, "open", fake)
    assert private._is_trusted(NOBODY) and private._is_trusted(0) and not private._is_trusted(1234)
    maps["uid_map"] = "0 0 4294967295\n"
    assert not private._is_trusted(NOBODY)


def test_systems_without_owners_have_caches_too(place, monkeypatch):
    """Windows' Python, for example, lacks ``geteuid`` and ``O_NOFOLLOW``."""
    monkeypatch.delattr(os, "geteuid", raising=False)
    monkeypatch.setattr(private, "_HAS_OWNERS", False)
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):
        monkeypatch.delattr(os, name, raising=False)
    store_entry("key", b"code")
    assert load_entry("key") == b"code"
    assert scratch.temporary_place() == (scratch.Place(Path(scratch.tempfile.gettempdir()) / "gpusense-0", "TMPDIR"))


# ---- the marker


def test_the_marker_keeps_the_folder_out_of_backups(place):
    folder = scratch.own_folder(place)
    assert (folder / "CACHEDIR.TAG").read_bytes().startswith(b"Signature: 8a477f597d28d172789f06886806bc55\n")


@pytest.mark.parametrize("marker", [None, b"", b"Signature", b"another's"])
def test_a_folder_that_gpusense_did_not_make_is_left_alone(place, caplog, marker):
    own = place / scratch.OWN
    own.mkdir(parents=True, mode=0o700)
    (own / "thesis.txt").write_text("mine")
    if marker is not None:
        (own / scratch.MARKER).write_bytes(marker)
    before = contents(place)
    store_entry("key", b"code")
    assert load_entry("key") == b"code" and contents(place) == before
    assert f"{own} must be a folder that gpusense has made, got one without its CACHEDIR.TAG" in caplog.messages[0]


@pytest.mark.parametrize("begun", [0, 1, 40, 97])
def test_a_marker_that_was_begun_is_completed(place, begun):
    own = place / scratch.OWN
    own.mkdir(parents=True, mode=0o700)
    (own / scratch.MARKER).write_bytes(scratch._MARKER_TEXT[:begun])
    scratch.own_folder(place)
    assert (own / scratch.MARKER).read_bytes() == scratch._MARKER_TEXT


_COLD = """
import sys
from gpusense.backends import cache
print("ready", flush=True)
sys.stdin.readline()
for number in range(40):
    cache.store_entry(f"{sys.argv[1]} {number}", b"payload" * 99)
assert all(cache.load_entry(f"{sys.argv[1]} {number}") for number in range(40))
"""


def test_processes_may_make_the_folder_at_once(place, tmp_path):
    """No process sees a folder without a marker, and no process reports anything."""
    started = [
        subprocess.Popen(
            [sys.executable, "-c", _COLD, f"{number}"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )
        for number in range(4)
    ]  # fmt: skip
    for process in started:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for process in started:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    assert [(process.communicate()[1], process.returncode) for process in started] == [("", 0)] * 4
    assert len(entries_in(place)) == 40 * 4


def test_a_regular_file_is_read_within_its_bound(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    assert read_regular(tmp_path / "file", 5) == b"12345" and read_regular(tmp_path / "file", 5, head=2) == b"12"
    with pytest.raises(OSError, match="must have at most 4 bytes, got 5"):
        read_regular(tmp_path / "file", 4)
    with pytest.raises(OSError, match="must be a regular file, got another kind"):
        read_regular(tmp_path, 5)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "absent", 5)
