"""Convolutions in 8-bit integers, against float64; and when the policy takes them."""

import pytest
import torch
import torch.nn.functional as F

from nlt.evaluation.clock import _AliveMemory
from nlt.models import policy
from nlt.models.int8 import convolve
from nlt.models.policy import Policy
from nlt.models.unet import UNet

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
        found = convolve(conv, x, {}, relu=False)
    weight, exact = conv.weight.detach().double(), x.double()
    step_x, step_w = exact.amax() / 252, weight.abs().amax((1, 2, 3), keepdim=True) / 127
    expected = F.conv2d(exact, weight, conv.bias.detach().double(), padding=1)
    ones = torch.ones_like(exact)
    bound = F.conv2d(ones * step_x, weight.abs() + step_w / 2, padding=1)
    bound += F.conv2d(exact, (step_w / 2).expand_as(weight), padding=1)
    assert ((found.double() - expected).abs() <= bound + 2**-8 * expected.abs()).all()
    assert (found.double() - expected).square().mean() < 4e-3 * expected.square().mean()
    assert found.dtype == torch.bfloat16 and found.is_contiguous(memory_format=torch.channels_last)


def test_positive_part_and_images_by_themselves():
    conv, x = made(64, 6, (8, 8), images=3)
    x[1] *= 1000
    packed = {}
    with torch.no_grad():
        together, positive = (convolve(conv, x, packed, relu=relu) for relu in (False, True))
        alone = [convolve(conv, image[None], packed, relu=False)[0] for image in x]
    assert torch.equal(positive, together.relu()) and (together < 0).any() and len(packed) == 1
    assert all(torch.equal(a, b) for a, b in zip(together, alone, strict=True))


def test_nothing_and_no_number():
    """Zeros leave the bias; what is not finite does not become a number."""
    conv, x = made(64, 6, (8, 8))
    with torch.no_grad():
        torch.testing.assert_close(
            convolve(conv, x * 0, {}, False).float(), conv.bias.view(1, -1, 1, 1).expand(1, 6, 8, 8), rtol=2**-8, atol=0
        )
        for wrong in (float("nan"), float("inf")):
            x[0, 3, 2, 2] = wrong
            assert not convolve(conv, x, {}, False)[0, :, 2, 2].isfinite().any()


def test_the_policy_takes_large_ones_without_gradients(monkeypatch):
    monkeypatch.setattr(policy, "_LEAST_PRODUCTS", 9 * 64 * 64 * 60)
    taken = []
    original = policy.int8.convolve
    monkeypatch.setattr(policy.int8, "convolve", lambda conv, *rest: taken.append(conv) or original(conv, *rest))
    torch.manual_seed(0)
    net, x = UNet(5, width=64, depth=1).eval(), torch.randn(2, 5, 8, 8)

    def run(how):
        taken.clear()
        with how.applied(CPU):
            return net(x), [name for name, module in net.named_modules() if module in taken]

    with torch.no_grad():
        expected, none = run(Policy())
        _, rather_not = run(Policy(bfloat16=True))
        image, names = run(Policy(bfloat16=True, int8=True))
    # At 8x8 the blocks' convolutions, at 4x4 that of 64 to 128 channels has too few products, the next enough.
    assert names == ["down.0.conv_0", "down.0.conv_1", "down.1.conv_1", "up.0.conv_0", "up.0.conv_1"]
    assert not none and not rather_not
    assert (image.float() - expected).square().mean() < 0.02**2 * expected.square().mean()
    assert not run(Policy(bfloat16=True, int8=True))[1]  # with gradients


def test_memory_is_counted():
    """As the clock does; what oneDNN has packed has no storage that could be asked."""
    conv, x = made(64, 64, (16, 16))
    with torch.no_grad(), _AliveMemory() as memory:
        y = convolve(conv, x, {}, relu=True)
    assert y.numel() * 2 + x.numel() <= memory.peak < 64 * (y.numel() + conv.weight.numel())


@pytest.mark.parametrize(("precision", "taken"), [("auto", True), ("bf16", False), ("32", False)])
def test_precisions(monkeypatch, precision, taken):
    has = {"avx512_bf16": True, "avx512_vnni": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: has)
    assert Policy.for_device(CPU, precision).int8 == taken
    has["avx512_vnni"] = False
    assert not Policy.for_device(CPU, precision).int8
    assert not Policy.for_device(torch.device("meta")).int8
