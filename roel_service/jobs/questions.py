"""What registration, localization and tracking are asked, with every file that they need named.

A child answers them without looking anything up.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from roel_service.config.stages import LocalizeConfig, RegisterConfig, TrackConfig
from roel_service.errors import CorruptionError, RoelError
from roel_service.geometry.se3 import SE3
from roel_service.jobs.cache_place import CachePlace
from roel_service.pano_loc.hints import Gravity, PosePrior
from roel_service.register.vertical import Vertical
from roel_service.scene.camera import Camera
from roel_service.scene.lines import LineMap
from roel_service.wire.rlm import decode_map


@dataclass(frozen=True, kw_only=True)
class StoredFile:
    """Bytes named by their digest.

    Attributes:
        name: what answers and errors call them.
        sha256: hexadecimal digest.
    """

    name: str
    path: Path
    sha256: str

    def read(self) -> bytes:
        """The bytes; raises `CorruptionError` unless they are what the digest says."""
        data = self.path.read_bytes()
        _check_digest(self, hashlib.sha256(data).hexdigest())
        return data

    def checked_path(self) -> Path:
        """Where they are, for a reader of files; raises as `read`."""
        with self.path.open("rb") as file:
            _check_digest(self, hashlib.file_digest(file, "sha256").hexdigest())
        return self.path


@dataclass(frozen=True, kw_only=True)
class MapFile(StoredFile):
    """The map file of a version."""

    def line_map(self) -> LineMap:
        """Its lines; raises as `read`."""
        return decode_map(self.read(), subject=self.name).line_map


@dataclass(frozen=True, eq=False, kw_only=True)
class RegisterQuestion:
    """A map to be laid over something.

    Attributes:
        target: another map, an uploaded cloud, or float32 points (N, 3), m, as bytes.
        T_init: first T_target_source; None: the identity.
        vertical: which way is up; None: as the parameters say.
        cache: where prepared targets are kept.
    """

    source: MapFile
    target: MapFile | StoredFile | bytes
    T_init: SE3 | None
    method: str
    vertical: Vertical | None
    config: RegisterConfig
    cache: CachePlace | None


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalizeQuestion:
    """A picture to be found in one of a few maps.

    Attributes:
        image: an encoded picture, uploaded or as it came.
        camera: that of an ordinary photograph, which has a prior; None: a panorama.
        max_hypothesis_count: of those in the answer.
        cache: where prepared maps are kept.
    """

    maps: tuple[MapFile, ...]
    image: StoredFile | bytes
    prior: PosePrior | None
    camera: Camera | None
    gravity: Gravity | None
    max_hypothesis_count: int
    config: LocalizeConfig
    cache: CachePlace | None


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackingBegins:
    """Where a camera begins to be tracked.

    Attributes:
        T_world_camera: about where it is at `t_us`; earlier events are passed over.
    """

    map: MapFile
    camera: Camera
    T_world_camera: SE3
    t_us: int
    config: TrackConfig


@dataclass(frozen=True, kw_only=True)
class NextChunk:
    """Encoded events."""

    seq: int
    data: bytes


@dataclass(frozen=True, eq=False, kw_only=True)
class NextGuess:
    """About where the camera is now."""

    T_world_camera: SE3


@dataclass(frozen=True, eq=False, kw_only=True)
class Told:
    """What became known by a few sayings.

    Attributes:
        poses: a serialized `TrackPosesResponse` each.
        error: what ended it; the poses are those from before.
    """

    poses: list[bytes]
    error: RoelError | None = None


Question = RegisterQuestion | LocalizeQuestion
Saying = NextChunk | NextGuess


def _check_digest(file: StoredFile, found: str) -> None:
    if found != file.sha256:
        raise CorruptionError(file.name, f"bytes of digest {file.sha256}", found)
