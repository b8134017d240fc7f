"""Make folders that other users cannot change, and read regular files within bounds.

Code in a folder is as trustworthy as everyone who can write there: its owner, users with write permission, and users
who can rename a folder above it. Windows and other systems without such owners protect users' folders by other rules;
only file types are checked there.
"""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

# Write permission of the group and of other users.
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_HAS_OWNERS = hasattr(os, "geteuid")


class UnsafeFolderError(PermissionError):
    """A folder that other users can change; the message names the folder and the rule."""


def make_private(folder: Path) -> None:
    """Make a folder and its missing parents, each private to this user, and check it."""
    absent = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    if absent and _HAS_OWNERS:
        _check_parents(absent[-1])
    for path in reversed(absent):
        # Another process may have made the folder.
        with contextlib.suppress(FileExistsError):
            path.mkdir(mode=0o700)
    check_private(folder)


def check_private(folder: Path) -> None:
    """Check that only this user can change or replace a folder (a ``realpath``); else raise UnsafeFolderError."""
    status = os.lstat(folder)
    if not stat.S_ISDIR(status.st_mode):
        kind = "a symbolic link" if stat.S_ISLNK(status.st_mode) else "another kind of file"
        raise UnsafeFolderError(f"{folder} must be a real directory, got {kind}")
    if not _HAS_OWNERS:
        return
    if status.st_uid != os.geteuid():
        raise UnsafeFolderError(f"{folder} must be owned by this user ({os.geteuid()}), got owner {status.st_uid}")
    if status.st_mode & _OTHERS_WRITE:
        mode = stat.S_IMODE(status.st_mode)
        raise UnsafeFolderError(f"{folder} must be writable by its owner only (mode 0700), got mode {mode:04o}")
    _check_parents(folder)


def _check_parents(folder: Path) -> None:
    """Check that other users cannot rename a folder or any folder above it."""
    for child, parent in zip((folder, *folder.parents), folder.parents, strict=False):
        _check_parent(parent, child.name)


def _check_parent(folder: Path, child: str) -> None:
    """Check that only this user and root can rename their files in a folder."""
    status = os.stat(folder)
    if not _is_trusted(status.st_uid):
        owner = f"this user ({os.geteuid()}) or root, got owner {status.st_uid}"
        raise UnsafeFolderError(f"{folder}, which holds {child}, must be owned by {owner}")
    if not status.st_mode & _OTHERS_WRITE or status.st_mode & stat.S_ISVTX:
        return
    if status.st_mode & stat.S_IWOTH or not _is_group_of_one(status.st_gid):
        mode = stat.S_IMODE(status.st_mode)
        raise UnsafeFolderError(
            f"{folder}, which holds {child}, must not be writable by others unless it is sticky, got mode {mode:04o}"
        )


def _is_trusted(owner: int) -> bool:
    """Return whether a file's owner is this user or root.

    In a user namespace all outside owners, including root, appear as one user without processes.
    """
    if owner in (0, os.geteuid()):
        return True
    try:
        with open("/proc/sys/kernel/overflowuid", encoding="ascii") as file:
            outside = int(file.read())
        with open("/proc/self/uid_map", encoding="ascii") as file:
            ranges = [tuple(map(int, line.split())) for line in file]
    except (OSError, ValueError):
        return False
    return owner == outside and not any(first <= owner < first + count for first, _, count in ranges)


def _is_group_of_one(group: int) -> bool:
    """Return whether a group is root's, or this user's private group of the same name."""
    if group == 0:
        return True
    import grp
    import pwd

    try:
        user, owners = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:
        return False
    return owners.gr_name == user.pw_name and user.pw_gid == group and set(owners.gr_mem) <= {user.pw_name}


def read_regular(path: Path, most: int, *, touch: bool = False, head: int | None = None) -> bytes:
    """Read a regular file of this user, at most ``most`` bytes, or its ``head``, and refuse any other file.

    Symbolic links are not followed, and a FIFO does not block. ``touch`` sets the file's times to now, if possible.
    """
    # Check the file type before, since opening some devices has side effects, and again for the opened file.
    _check_regular(os.lstat(path), path, most)
    flags = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
    with os.fdopen(os.open(path, os.O_RDONLY | flags), "rb") as file:
        _check_regular(os.fstat(file.fileno()), path, most)
        if touch and os.utime in os.supports_fd:
            # A read-only file system keeps the times.
            with contextlib.suppress(OSError):
                os.utime(file.fileno())
        data = file.read(most + 1 if head is None else head)
    if len(data) > most:
        raise OSError(f"{path} must have at most {most} bytes, got more")
    return data


def _check_regular(status: os.stat_result, path: Path, most: int) -> None:
    """Check the kind, the owner and the size of a file."""
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f"{path} must be a regular file, got another kind")
    if _HAS_OWNERS and status.st_uid != os.geteuid():
        raise OSError(f"{path} must be owned by this user ({os.geteuid()}), got owner {status.st_uid}")
    if status.st_size > most:
        raise OSError(f"{path} must have at most {most} bytes, got {status.st_size}")
