"""The correction of a learned image by its noisy pixels, against a loop in float64 and on scenes of known error."""

import numpy as np
import pytest
import torch
from synthetic import synthetic_batch

from nlt.baselines.guided import GuidedOneSample
from nlt.models.correction import LEAST_ALBEDO, _fit, correction

SIZE = 64


def one_sample_noise(truth: torch.Tensor, seed: int) -> torch.Tensor:
    """Return pixels with the mean `truth`, of which four in five are black, as path tracing of a dim scene gives."""
    generator = torch.Generator().manual_seed(seed)
    return truth * 5 * (torch.rand(truth.shape, generator=generator) < 0.2)


def scene(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return albedo, true image, brightness and the mask of valid pixels."""
    albedo = torch.rand(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(seed))
    truth = 0.3 * (albedo + LEAST_ALBEDO)
    return albedo, truth, truth.mean(1, keepdim=True), torch.ones(1, 1, SIZE, SIZE, dtype=torch.bool)


def test_fit_equals_a_loop():
    """Least squares and the variance of its factor, window by window, with a last row and column of partial windows."""
    generator = torch.Generator().manual_seed(1)
    shape, size = (1, 3, 20, 28), 8
    rest, albedo = torch.randn(shape, generator=generator), 0.1 + torch.rand(shape, generator=generator)
    weight = torch.rand(1, 1, *shape[2:], generator=generator)
    fitted, relative = _fit(rest, albedo, weight, size)
    rows, columns = -(-shape[2] // size), -(-shape[3] // size)
    assert fitted.shape == relative.shape == (1, 3, rows, columns)
    r, a, w = (x.expand(shape)[0].double().numpy() for x in (rest, albedo, weight))
    errors, shares, factors = np.empty((3, 3, rows, columns))
    for channel, row, column in np.ndindex(errors.shape):
        cut = (channel, slice(row * size, (row + 1) * size), slice(column * size, (column + 1) * size))
        x, y = (np.sqrt(w[cut]) * a[cut]).ravel(), (np.sqrt(w[cut]) * r[cut]).ravel()
        (factors[channel, row, column],), *_ = np.linalg.lstsq(x[:, None], y)
        leverage = (x**4).sum() / (x**2).sum() ** 2
        errors[channel, row, column] = (x**2 * (y - factors[channel, row, column] * x) ** 2).sum() / (1 - leverage)
        shares[channel, row, column] = (x**2).sum()
    variance = np.empty_like(errors)
    for channel, row, column in np.ndindex(errors.shape):
        near = (channel, slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2))
        around = errors[near].mean() / shares[near].mean() * shares[channel, row, column]
        variance[channel, row, column] = max(errors[channel, row, column], around) / shares[channel, row, column] ** 2
    np.testing.assert_allclose(fitted[0].numpy(), factors, rtol=1e-4)
    np.testing.assert_allclose(relative[0].numpy(), variance / factors**2, rtol=1e-3)


def test_a_wrong_image_is_corrected():
    """An image of a third of the light, in one half of which a lamp is missing altogether: 20 times less error."""
    albedo, truth, _, valid = scene()
    image = truth / 3
    image[..., SIZE // 2 :] = 0
    noisy = one_sample_noise(truth, 2)
    missing = correction(noisy - image, albedo, image.mean(1, keepdim=True), valid)
    corrected = image + (albedo + LEAST_ALBEDO) * missing
    assert (corrected - truth).square().mean() < (image - truth).square().mean() / 20


def test_noise_alone_changes_little():
    """A right image stays right: the correction's square is at most a fiftieth of the noise's."""
    albedo, truth, brightness, valid = scene()
    added, noise = 0.0, 0.0
    for seed in range(20):
        residual = one_sample_noise(truth, seed) - truth
        missing = correction(residual, albedo, brightness, valid)
        added += float(((albedo + LEAST_ALBEDO) * missing).square().mean())
        noise += float(residual.square().mean())
    assert 0 < added < noise / 50


def test_left_out_pixels_do_not_count():
    albedo, truth, brightness, valid = scene()
    residual = one_sample_noise(truth, 3) - truth / 2
    valid[..., 10:20, 30:40] = False
    expected = correction(residual, albedo, brightness, valid)
    residual[..., 10:20, 30:40] = 1e4
    torch.testing.assert_close(correction(residual, albedo, brightness, valid), expected)
    assert not correction(residual, albedo, brightness, torch.zeros_like(valid)).any()


@pytest.mark.parametrize("height,width", [(3, 5), (8, 8), (33, 70)])
def test_any_size(height, width):
    albedo = torch.rand(2, 3, height, width)
    missing = correction(0.7 * (albedo + LEAST_ALBEDO), albedo, albedo[:, :1], albedo[:, :1] > 0)
    torch.testing.assert_close(missing, torch.full_like(albedo, 0.7))


@pytest.mark.parametrize("gap", [0, 1])
@pytest.mark.parametrize("direct_light", [False, True])
def test_a_denoiser_in_a_strange_light(gap, direct_light):
    """Whatever a random network predicts, with `corrected` the image has the noisy pixels' mean, lamps apart."""
    batch = synthetic_batch(size=64)
    batch["emission"].zero_()
    batch["emission"][:, :, :4, :4] = 1e4
    light = 40 * (batch["seen_albedo" if direct_light else "albedo"] + LEAST_ALBEDO)
    batch["noisy"] = light * (0.5 + torch.rand(light.shape)) + batch["emission"]
    torch.manual_seed(0)
    settings = {"width": 4, "depth": 1, "output": "demodulated", "gap": gap, "direct_light": direct_light}
    with torch.no_grad():
        plain, method = (GuidedOneSample(**settings, corrected=corrected) for corrected in (False, True))
        method.load_state_dict(plain.state_dict())
        away = (slice(None), slice(None), slice(8, None))
        wrong, image = ((m(batch)[away] - light[away]).square().mean().sqrt() for m in (plain, method))
        assert image < light.mean() / 10 < wrong / 5
        torch.testing.assert_close(method(batch)[:, :, :4, :4], plain(batch)[:, :, :4, :4], rtol=0.05, atol=0)
