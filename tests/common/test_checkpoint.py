"""Files that are never half written, damage that is noticed, and reading that runs no code."""

import errno
import fcntl
import json
import os
import random
import resource
import shutil
import stat
import struct
import warnings
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
import torch as th

from helpers import MakePEARL
from helpers.bombs import Bomb
from helpers.disks import disk
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checkpoint import (
    CHECKPOINTS,
    MANIFEST,
    STATE,
    DamagedCheckpoint,
    checkpoints,
    load_latest,
    read_checkpoint,
    write_checkpoint,
)


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "new" / "file.txt"
    with atomic_path(file) as path:
        path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(file) as path:
        path.write_text("half")
        raise KeyboardInterrupt
    assert file.read_text() == "old"
    assert list(file.parent.iterdir()) == [file]
    with atomic_path(tmp_path / "new") as folder:
        folder.mkdir()
        (folder / "other").write_text("x")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["other"]


def test_files_are_synced_by_handles_that_may_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows syncs no others."""
    fsync, synced = os.fsync, []

    def fsync_of_windows(handle: int) -> None:
        if stat.S_ISREG(os.fstat(handle).st_mode):
            assert fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDWR
            synced.append(handle)
        fsync(handle)

    monkeypatch.setattr("os.fsync", fsync_of_windows)
    with atomic_path(tmp_path / "file") as path:
        path.write_text("whole")
    assert len(synced) == 1 and (tmp_path / "file").read_text() == "whole"


def test_a_file_is_written_where_folders_cannot_be_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on VirtualBox's shared folders."""
    fsync = os.fsync

    def fsync_of_files(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr("os.fsync", fsync_of_files)
    write_checkpoint(tmp_path / "1_steps", {"x": 1})
    assert read_checkpoint(tmp_path / "1_steps") == {"x": 1}


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (RuntimeError("[enforce fail at inline_container.cc:603] . unexpected pos 192 vs 91"), OSError),
        (RuntimeError("basic_ios::clear: iostream error"), OSError),
        (ValueError("ZIP does not support timestamps before 1980"), OSError),
        (struct.error("'H' format requires 0 <= number <= 65535"), OSError),
        (RuntimeError("CUDA error: an illegal memory access was encountered"), RuntimeError),
        (ValueError("all input arrays must have the same shape"), ValueError),
    ],
)
def test_a_full_disk_is_told_from_an_error_of_the_program(error: Exception, expected: Any, tmp_path: Path) -> None:
    with pytest.raises(expected), atomic_path(tmp_path / "file"):
        raise error


def test_a_full_disk_is_told_with_the_file_that_it_has_no_room_for(tmp_path: Path) -> None:
    with disk(tmp_path, 16) as small, pytest.raises(OSError, match=rf"No space left on device: '{small / 'data'}'"):
        with atomic_path(small / "data") as temporary:
            temporary.write_bytes(bytes(2**16))


def test_a_file_is_no_folder_to_write_to(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("precious")
    with pytest.raises(OSError, match=rf"This is a file, expected a folder: '{tmp_path / 'results'}'"):
        with atomic_path(tmp_path / "results" / "data"):
            pass
    assert (tmp_path / "results").read_text() == "precious"


def test_a_file_does_not_replace_a_folder(tmp_path: Path) -> None:
    (tmp_path / "model.zip").mkdir()
    (tmp_path / "model.zip" / "precious").touch()
    with pytest.raises(OSError), atomic_path(tmp_path / "model.zip") as temporary:
        temporary.touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["model.zip", "precious"]


def truncate(folder: Path) -> None:
    data = (folder / STATE).read_bytes()
    (folder / STATE).write_bytes(data[: len(data) // 2])


def flip_a_bit(folder: Path) -> None:
    data = bytearray((folder / STATE).read_bytes())
    data[len(data) // 3] ^= 1
    (folder / STATE).write_bytes(bytes(data))


def empty(folder: Path) -> None:
    (folder / STATE).write_bytes(b"")


def remove_state(folder: Path) -> None:
    (folder / STATE).unlink()


def remove_manifest(folder: Path) -> None:
    (folder / MANIFEST).unlink()


def garble_manifest(folder: Path) -> None:
    (folder / MANIFEST).write_text("{")


def foreign_format(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps({**manifest, "format": 999}))


def other_versions(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps({**manifest, "versions": []}))


DAMAGES = [truncate, flip_a_bit, empty, remove_state, remove_manifest, garble_manifest, foreign_format, other_versions]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_gives_one_sentence_and_the_next_older_one_is_taken(
    damage: Callable[[Path], None], tmp_path: Path
) -> None:
    for steps in (240, 1200, 960):
        write_checkpoint(tmp_path / "checkpoints" / f"{steps}_steps", {"steps": steps, "weights": th.ones(3)})
    newest, older, oldest = checkpoints(tmp_path)
    assert load_latest(tmp_path)[1]["steps"] == 1200
    damage(newest)
    with pytest.raises(DamagedCheckpoint) as error:
        read_checkpoint(newest)
    assert str(newest) in str(error.value) and len(str(error.value).split(". ")) == 1
    with pytest.warns(UserWarning, match="next older checkpoint"):
        folder, state = load_latest(tmp_path)
    assert folder == older and state["steps"] == 960
    damage(older)
    damage(oldest)
    with warnings.catch_warnings(), pytest.raises(FileNotFoundError, match="no checkpoint to go on from"):
        warnings.simplefilter("ignore")
        load_latest(tmp_path)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is measured as Linux does")
def test_too_little_memory_is_no_damage(tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    """The latest checkpoint is whole: a training that went on from an older one would write over it."""
    write_checkpoint(tmp_path / CHECKPOINTS / "2_steps", {"ring": th.zeros(3 * 10**7)})
    write_checkpoint(tmp_path / CHECKPOINTS / "1_steps", {})
    shutil.copy(tmp_path / CHECKPOINTS / "2_steps" / STATE, tmp_path / "replay.pt")
    model, context = tiny_pearl(), get_context("fork")  # a new interpreter would import torch once more
    said = context.SimpleQueue()

    def read_both() -> None:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 6 * 10**7,) * 2)
        for read, path in (load_latest, tmp_path), (model.load_replay_buffer, tmp_path / "replay.pt"):
            try:
                read(path)
                said.put("it was read")
            except Exception as error:
                said.put(f"{type(error).__name__}: {error}")

    process = context.Process(target=read_both)
    process.start()
    process.join(60)
    process.kill()
    assert process.exitcode == 0
    for path in (tmp_path / CHECKPOINTS / "2_steps", tmp_path / "replay.pt"):
        assert said.get().startswith(f"MemoryError: There is too little memory to read {path}")


def test_damage_at_350_places_is_noticed_or_harmless(tmp_path: Path) -> None:
    """200 bits flipped and 150 truncations, in the state and in the manifest."""
    folder = tmp_path / "1_steps"
    write_checkpoint(folder, {"weights": th.arange(100.0), "name": "x"})
    whole = {name: (folder / name).read_bytes() for name in (STATE, MANIFEST)}
    places, noticed = random.Random(0), 0
    for i in range(350):
        name = places.choice((STATE, STATE, MANIFEST))
        damaged = bytearray(whole[name])
        if i < 200:
            damaged[places.randrange(len(damaged))] ^= 1 << places.randrange(8)
        else:
            del damaged[places.randrange(len(damaged)) :]
        (folder / name).write_bytes(damaged)
        try:
            state = read_checkpoint(folder)
        except DamagedCheckpoint:
            noticed += 1
        else:  # in the versions of the manifest, which change nothing
            assert name == MANIFEST and i < 200 and th.equal(state["weights"], th.arange(100.0)) and state["name"] == "x"
        (folder / name).write_bytes(whole[name])
    assert noticed > 300


def test_what_could_not_be_read_without_running_code_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\['bomb'\] is a .*Bomb"):
        write_checkpoint(tmp_path / "1_steps", {"bomb": Bomb(tmp_path / "fuse")})


def test_who_wrote_a_checkpoint_may_be_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Older versions did not say, where the package was on the path and not installed."""
    monkeypatch.setattr("sb3_htr.common.checkpoint.versions", lambda: {"python": "3"})
    write_checkpoint(tmp_path / "1_steps", {"x": 1})
    assert read_checkpoint(tmp_path / "1_steps") == {"x": 1}
