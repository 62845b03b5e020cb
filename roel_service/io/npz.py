"""NPZ archives without pickle: members as streams or arrays, sizes checked before allocation."""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import InputError
from roel_service.io.files import open_input, whole_file

# What damage raises out of zipfile, depending on where it is.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError,
    ValueError, KeyError, OverflowError,
)  # fmt: skip

# The header that numpy writes, for plain numbers. Parsed here and not by numpy, whose parser
# evaluates literals and so fails in as many ways as Python's own.
_HEADER = re.compile(
    rb"\{'descr': '([<>|]?(?:[iu][1248]|f[248]|b1))', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d{1,18}(?:, ?|(?=\))))*)\),? *\} *\n"
)
_MAX_HEADER_BYTES = 4096

# No deflate stream expands further than this; a member that claims more is damaged or hostile.
_MAX_DEFLATE_RATIO = 1032


@dataclass(frozen=True, kw_only=True)
class NpzMember:
    """One array of an archive, positioned at its first value.

    Attributes:
        dtype, shape: as the header says, and as the archive is long enough to hold.
        is_fortran: whether the first axis varies fastest.
        stream: the decompressed values.
    """

    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    is_fortran: bool
    stream: IO[bytes]

    def read(self, count: int) -> Array:
        """The next `count` values, in the order of the file.

        Raises:
            EOFError: the archive holds fewer.
        """
        data = self.stream.read(count * self.dtype.itemsize)
        if len(data) != count * self.dtype.itemsize:
            raise EOFError("a member that ends too early")
        values = np.frombuffer(data, self.dtype)
        return values.astype(self.dtype.newbyteorder("="), copy=False)

    def array(self) -> Array:
        """The whole array."""
        values = self.read(math.prod(self.shape))
        return values.reshape(self.shape, order="F" if self.is_fortran else "C")


@contextmanager
def open_members(
    path: Path, names: tuple[str, ...], subject: str, error: type[InputError]
) -> Iterator[dict[str, NpzMember]]:
    """Open those of the named arrays that the archive holds.

    Raises:
        InputError: of type `error`; no sound archive, or an array that is not of plain numbers.
            Damage met while the block reads is raised in the same way.
    """
    try:
        with ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(stack.enter_context(open_input(path))))
            held = set(archive.namelist())
            yield {
                name: _member(stack, archive, f"{name}.npy")
                for name in names
                if f"{name}.npy" in held
            }
    except _DAMAGE as damage:
        found = str(damage) or type(damage).__name__
        raise error(subject, "an undamaged NPZ archive of plain numbers", found) from damage


def read_npz(
    path: Path, names: tuple[str, ...], subject: str, error: type[InputError]
) -> dict[str, Array]:
    """Those of the named arrays that the archive holds; raises as `open_members`."""
    with open_members(path, names, subject, error) as members:
        return {name: member.array() for name, member in members.items()}


def _member(stack: ExitStack, archive: zipfile.ZipFile, name: str) -> NpzMember:
    info = archive.getinfo(name)
    ratio = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: _MAX_DEFLATE_RATIO}
    if info.file_size > info.compress_size * ratio.get(info.compress_type, 0):
        raise ValueError(f"{name} claims {info.file_size} bytes in {info.compress_size}")
    stream = stack.enter_context(archive.open(info))
    magic = stream.read(8)
    if magic[:6] != b"\x93NUMPY" or magic[6:7] not in (b"\1", b"\2", b"\3"):
        raise ValueError(f"{name} is no array")
    length_bytes = 2 if magic[6:7] == b"\1" else 4
    header_bytes = int.from_bytes(stream.read(length_bytes), "little")
    header = _HEADER.fullmatch(stream.read(min(header_bytes, _MAX_HEADER_BYTES)))
    if header is None:
        raise ValueError(f"{name} is no array of plain numbers")
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(size) for size in header[3].split(b",") if size.strip())
    if 8 + length_bytes + header_bytes + math.prod(shape) * dtype.itemsize != info.file_size:
        raise ValueError(f"{name} of shape {shape} in {info.file_size} bytes")
    return NpzMember(dtype=dtype, shape=shape, is_fortran=header[2] == b"True", stream=stream)


def write_npz(path: Path, **arrays: Array) -> None:
    """Write arrays so that equal arrays give equal bytes: no clock, fixed compression."""
    with whole_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            # The earliest date that the format knows.
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
