"""Design files: what is written is read, and nothing else is taken for one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zfusion.errors import InputError
from zfusion.methods.design_files import VERSION, DesignFileError, fingerprint, packed, read, unpack, write


def written(path: Path, **change: Any) -> Path:
    """A design file in which the head may say something else."""
    head = {"format": "zfusion design", "version": VERSION, "method": "m", "fingerprint": "f"} | change
    np.savez(path, allow_pickle=False, **{name: np.asarray(value) for name, value in head.items()}, K=np.eye(2))
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a design"  # the name stays as it is, without an ending that nobody asked for
    write(path, packed("m", "f", {"K": np.eye(2), "ids": np.array(["a", "b"]), "J": np.array(1.5)}))
    arrays = unpack(read(path), "m", "f")
    assert sorted(arrays) == ["J", "K", "ids"]
    np.testing.assert_array_equal(arrays["K"], np.eye(2))
    assert arrays["ids"].tolist() == ["a", "b"]
    assert unpack(read(path), "m").keys() == arrays.keys()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "something"}, "not a design file"),
        ({"version": VERSION + 1}, f"version {VERSION + 1}; this zfusion reads version {VERSION}"),
        ({"method": "other"}, "the method 'other', expected one of 'm'"),
        ({"fingerprint": "g"}, "designed for another system"),
    ],
)
def test_foreign_files_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    with pytest.raises(DesignFileError, match=words):
        unpack(read(written(tmp_path / "d.npz", **change)), "m", "f")


def test_files_that_are_no_archives_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("K = 1")
    np.save(tmp_path / "array.npy", np.eye(2))
    whole = written(tmp_path / "d.npz").read_bytes()
    (tmp_path / "cut").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty").write_bytes(b"")
    np.savez(tmp_path / "pickled.npz", format=np.array([{}], dtype=object))
    np.savez(tmp_path / "headless.npz", K=np.eye(2))
    for name in ("text", "array.npy", "cut", "empty", "pickled.npz", "headless.npz"):
        with pytest.raises(DesignFileError, match="not a design file"):
            unpack(read(tmp_path / name), "m")
    with pytest.raises(DesignFileError, match="there is no such file"):
        read(tmp_path / "nothing.npz")


def test_what_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write(tmp_path / "no" / "such" / "directory.npz", packed("m", "f", {}))
    with pytest.raises(ValueError, match="taken"):
        packed("m", "f", {"method": np.array(1)})


def test_fingerprints_see_numbers_and_not_rounding() -> None:
    matrix = np.array([[0.1, -0.0], [3.0, 1e-20]])
    known = fingerprint([("A", matrix), ("ids", "(1, 2)")])
    assert fingerprint([("A", matrix * (1 + 1e-15) + 0.0), ("ids", "(1, 2)")]) == known
    others = [
        [("A", matrix * 1.000001), ("ids", "(1, 2)")],
        [("A", matrix.T), ("ids", "(1, 2)")],
        [("A", matrix.reshape(4)), ("ids", "(1, 2)")],
        [("B", matrix), ("ids", "(1, 2)")],
        [("A", matrix), ("ids", "(1, 3)")],
    ]
    assert len({known, *(fingerprint(parts) for parts in others)}) == 6
