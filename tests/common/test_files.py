"""Atomic writes, on disks that fill up and processes that die."""

import errno
import os
import re
import resource
from pathlib import Path
from typing import BinaryIO

import pytest

from sb3_poem.common.files import write_atomically


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file that was there before, alone in its folder."""
    path = tmp_path / "folder" / "model.zip"
    path.parent.mkdir()
    path.write_bytes(b"before")
    return path


def assert_untouched(path: Path) -> None:
    assert path.read_bytes() == b"before"
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize("content", [b"after", b"", bytes(range(256)) * 10_000])
def test_replaces_the_file(path: Path, content: bytes) -> None:
    write_atomically(path, content)
    assert path.read_bytes() == bytes(content)
    assert os.listdir(path.parent) == [path.name]


def test_a_function_may_write(path: Path) -> None:
    write_atomically(path, lambda file: file.write(b"after"))
    assert path.read_bytes() == b"after"

    def fail(file: BinaryIO) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_bytes() == b"after"
    assert os.listdir(path.parent) == [path.name]


def test_makes_folders_and_takes_strings(tmp_path: Path) -> None:
    write_atomically(str(tmp_path / "a" / "b" / "c.bin"), b"x")
    assert (tmp_path / "a" / "b" / "c.bin").read_bytes() == b"x"


def test_a_link_stays_one(path: Path, tmp_path: Path) -> None:
    for name, target in (("link", path), ("dangling", tmp_path / "elsewhere" / "new")):
        (tmp_path / name).symlink_to(target)
        write_atomically(tmp_path / name, b"after")
        assert (tmp_path / name).is_symlink()
        assert target.read_bytes() == b"after"


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_permissions_are_those_of_any_new_file(path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        write_atomically(path, b"after")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == mode


@pytest.mark.parametrize(("call", "code"), [("fsync", errno.ENOSPC), ("replace", errno.EROFS)])
def test_a_failure_leaves_the_previous_file_whole(
    path: Path, call: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match=r"could not write .*model\.zip .*untouched") as caught:
        write_atomically(path, b"after")
    assert caught.value.errno == code
    assert os.strerror(code) in str(caught.value)
    assert_untouched(path)


def test_an_interrupt_leaves_the_previous_file_whole(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"after")
    assert_untouched(path)


def test_a_full_disk_leaves_the_previous_file_whole(path: Path) -> None:
    """The kernel stops the write half-way, as it does on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))
    try:
        with pytest.raises(OSError, match=re.escape(str(path))) as caught:
            write_atomically(path, b"x" * 3_000_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG
    assert_untouched(path)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match=r"could not write .*file/model\.zip"):
        write_atomically(tmp_path / "file" / "model.zip", b"x")
    (tmp_path / "model.zip").mkdir()
    with pytest.raises(OSError, match=r"could not write .*model\.zip"):
        write_atomically(tmp_path / "model.zip", b"x")
    assert sorted(os.listdir(tmp_path)) == ["file", "model.zip"]
