"""Convolutions in 8-bit integers, against float64; and when the policy takes them."""

import pytest
import torch
import torch.nn.functional as F
from synthetic import POINTS, SCENES, synthetic_batch

from nlt.baselines.cnn import CNN
from nlt.evaluation.clock import _AliveMemory
from nlt.models import int8
from nlt.models.int8 import Int8Conv2d, convolve, pack
from nlt.models.nlt import NeuralLightTransport
from nlt.models.policy import Policy, accelerate

CPU = torch.device("cpu")


def made(channels, out, size, images=1, seed=0):
    """A convolution, and images that are not negative, of heavy tails, as lamps make them."""
    torch.manual_seed(seed)
    conv = torch.nn.Conv2d(channels, out, 3, padding=1)
    x = torch.randn(images, channels, *size).exp() * (torch.rand(images, channels, *size) < 0.5)
    return conv, x.bfloat16().contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(("channels", "size"), [(64, (9, 14)), (70, (1, 5)), (3, (700, 250))])
def test_error_is_that_of_rounding(channels, size):
    """At each pixel at most what half a step of each weight and one of each input can make, and bfloat16's own."""
    conv, x = made(channels, 8, size)
    with torch.no_grad():
        found = convolve(conv, x, pack(conv))
    weight, exact = conv.weight.detach().double(), x.double()
    step_x, step_w = exact.amax() / 252, weight.abs().amax((1, 2, 3), keepdim=True) / 127
    expected = F.conv2d(exact, weight, conv.bias.detach().double(), padding=1)
    ones = torch.ones_like(exact)
    bound = F.conv2d(ones * step_x, weight.abs() + step_w / 2, padding=1)
    bound += F.conv2d(exact, (step_w / 2).expand_as(weight), padding=1)
    assert ((found.double() - expected).abs() <= bound + 2**-8 * expected.abs()).all()
    assert (found.double() - expected).square().mean() < 4e-3 * expected.square().mean()
    assert found.dtype == torch.bfloat16 and found.is_contiguous(memory_format=torch.channels_last)


def test_an_image_does_not_depend_on_its_batch():
    conv, x = made(64, 6, (8, 8), images=3)
    x[1] *= 1000
    packed = pack(conv)
    with torch.no_grad():
        together = convolve(conv, x, packed)
        alone = [convolve(conv, image[None], packed)[0] for image in x]
    assert all(torch.equal(a, b) for a, b in zip(together, alone, strict=True))


def test_nothing_and_no_number():
    """Zeros leave the bias; what is not finite does not become a number."""
    conv, x = made(64, 6, (8, 8))
    with torch.no_grad():
        torch.testing.assert_close(
            convolve(conv, x * 0, pack(conv)).float(),
            conv.bias.view(1, -1, 1, 1).expand(1, 6, 8, 8),
            rtol=2**-8,
            atol=0,
        )
        for wrong in (float("nan"), float("inf")):
            x[0, 3, 2, 2] = wrong
            assert not convolve(conv, x, pack(conv))[0, :, 2, 2].isfinite().any()


def test_accelerate_takes_large_ones(monkeypatch):
    monkeypatch.setattr(int8, "_LEAST_PRODUCTS", 9 * 64 * 64 * 60)
    taken = []
    original = int8.convolve
    monkeypatch.setattr(int8, "convolve", lambda conv, *rest: taken.append(conv) or original(conv, *rest))
    torch.manual_seed(0)
    method, batch = CNN(width=64, depth=1).eval(), synthetic_batch(size=8)

    def run(policy):
        taken.clear()
        fast = accelerate(method, policy, CPU)
        parts = {part: name for name, part in fast.unet.named_modules() if isinstance(part, torch.nn.Conv2d)}
        return fast(batch), sorted({parts[conv].removesuffix(".conv") for conv in taken})

    with torch.no_grad():
        expected, none = run(Policy())
        _, rather_not = run(Policy(bfloat16=True))
        image, names = run(Policy(bfloat16=True, int8=True))
    # At 8x8 the blocks' convolutions, at 4x4 that of 64 to 128 channels has too few products, the next enough.
    assert names == ["down.0.conv_0", "down.0.conv_1", "down.1.conv_1", "up.0.conv_0", "up.0.conv_1"]
    assert not none and not rather_not
    assert (image.float() - expected).square().mean() < 0.02**2 * expected.square().mean()
    assert not any(isinstance(part, Int8Conv2d) for part in method.modules())  # the method itself stays as it was


def test_bfloat16_computes_what_autocast_does():
    torch.manual_seed(0)
    method, batch = (
        NeuralLightTransport(use_photons=True, width=4, num_points=POINTS, num_scenes=SCENES).eval(),
        synthetic_batch(),
    )
    with torch.no_grad():
        with torch.autocast("cpu", torch.bfloat16):
            expected = method(batch)
        assert torch.equal(accelerate(method, Policy(bfloat16=True), CPU)(batch), expected)


def test_memory_is_counted():
    """As the clock does; what oneDNN has packed has no storage that could be asked."""
    conv, x = made(64, 64, (16, 16))
    with torch.no_grad(), _AliveMemory() as memory:
        y = convolve(conv, x, pack(conv))
    assert y.numel() * 2 + x.numel() <= memory.peak < 64 * (y.numel() + conv.weight.numel())


@pytest.mark.parametrize(("precision", "taken"), [("auto", True), ("bf16", False), ("32", False)])
def test_precisions(monkeypatch, precision, taken):
    has = {"avx512_bf16": True, "avx512_vnni": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: has)
    assert Policy.for_device(CPU, precision).int8 == taken
    has["avx512_vnni"] = False
    assert not Policy.for_device(CPU, precision).int8
    has |= {"cpu_name": "Intel Xeon", "amx_bf16": False}
    assert Policy.for_device(CPU, precision).bfloat16 == (precision == "bf16"), "without AMX, float32 is faster"
    has["amx_bf16"] = True
    assert Policy.for_device(CPU, precision).bfloat16 == (precision != "32")
    assert not Policy.for_device(torch.device("meta")).int8
