"""The U-Net: shapes, number of parameters, memory layout."""

import pytest
import torch
import torch.nn.functional as F

from nlt.models.projection import SparseMap
from nlt.models.unet import ConvBlock, UNet, UpBlock, sparse_convolution


@pytest.mark.parametrize("size", [(16, 16), (13, 22), (1, 5), (8, 3)])
@pytest.mark.parametrize("depth", [0, 1, 3, 4])
def test_shape(size, depth):
    net = UNet(5, width=4, depth=depth, out_channels=2)
    assert net(torch.randn(2, 5, *size)).shape == (2, 2, *size)


def test_up_block_equals_the_block_on_what_is_joined():
    torch.manual_seed(0)
    block = UpBlock(7, 4).double()
    x, skip = torch.randn(2, 5, 3, 4, dtype=torch.float64), torch.randn(2, 2, 6, 7, dtype=torch.float64)
    joined = torch.cat([F.interpolate(x, size=(6, 7), mode="bilinear", align_corners=False), skip], dim=1)
    torch.testing.assert_close(block(x, skip), ConvBlock.forward(block, joined))


@pytest.mark.parametrize("size", [(5, 7), (1, 4), (3, 1)])
def test_sparse_convolution(size):
    """As of the dense maps, several rows at a pixel and pixels at all borders included."""
    torch.manual_seed(0)
    conv = torch.nn.Conv2d(9, 6, 3, padding=1).double()
    x, sparse, dense = torch.randn(3, 2, *size, dtype=torch.float64), [], []
    for channels in (3, 4):
        pixels = torch.randint(3 * size[0] * size[1], (70,))
        assert len(pixels.unique()) < 70
        rows = torch.randn(70, channels, dtype=torch.float64)
        image = torch.zeros(3, *size, channels, dtype=torch.float64)
        for row, pixel in zip(rows, pixels, strict=True):
            image.view(-1, channels)[pixel] += row
        sparse.append(SparseMap(rows, pixels))
        dense.append(image.permute(0, 3, 1, 2))
    with torch.no_grad():
        torch.testing.assert_close(sparse_convolution(conv, x, sparse), conv(torch.cat([x, *dense], dim=1)))


def test_number_of_parameters():
    """Width 64, three steps: counted by hand from the supplementary's figure."""

    def conv(a, b):
        return 9 * a * b + b

    def block(a, b):
        return conv(a, b) + conv(b, b) + (a * b if a != b else 0)

    down = block(64, 64) + block(64, 128) + block(128, 256) + block(256, 512)
    up = block(512 + 256, 256) + block(256 + 128, 128) + block(128 + 64, 64)
    expected = conv(10, 64) + down + up + conv(64, 3)
    assert sum(p.numel() for p in UNet(10).parameters()) == expected


def test_channels_last_gives_the_same():
    torch.manual_seed(0)
    net, x = UNet(3, width=4), torch.randn(1, 3, 20, 12)
    expected = net(x)
    net = net.to(memory_format=torch.channels_last)
    result = net(x.contiguous(memory_format=torch.channels_last))
    torch.testing.assert_close(result, expected, atol=1e-5, rtol=1e-4)


def test_receptive_field_spans_the_levels():
    """A change at one pixel is seen far beyond what the convolutions at full resolution reach."""
    torch.manual_seed(0)
    net, x = UNet(1, width=4), torch.zeros(1, 1, 32, 32, requires_grad=True)
    net(x + torch.rand(x.shape))[0, :, 0, 0].sum().backward()
    assert x.grad[0, 0, :, 0].nonzero().max() >= 16


@pytest.mark.parametrize("size", [(8, 6), (7, 5), (1, 3)])
def test_patches(size):
    """Patches need not divide the image, and sparse maps give the same as dense ones."""
    torch.manual_seed(0)
    net = UNet(5, width=4, depth=1, out_channels=2, patch=2).double().eval()
    x = torch.randn(3, 3, *size, dtype=torch.float64)
    rows, pixels = torch.randn(40, 2, dtype=torch.float64), torch.randint(3 * size[0] * size[1], (40,))
    image = torch.zeros(3, *size, 2, dtype=torch.float64)
    image.view(-1, 2).index_add_(0, pixels, rows)
    dense = net(torch.cat([x, image.permute(0, 3, 1, 2)], dim=1))
    assert dense.shape == (3, 2, *size)
    with torch.no_grad():
        torch.testing.assert_close(net(x, [SparseMap(rows, pixels)]), dense)


def test_pixels_of_a_patch_are_told_apart():
    """Without any level, too: each one's output depends on all pixels of the patch."""
    torch.manual_seed(0)
    net, x = UNet(1, width=4, depth=0, patch=2), torch.randn(1, 1, 24, 24, requires_grad=True)
    values = net(x)[0, 0, 12:14, 12:14].flatten()
    gradients = [torch.autograd.grad(value, x, retain_graph=True)[0][0, 0, 12:14, 12:14] for value in values]
    assert all(gradient.all() for gradient in gradients)
    assert not any(torch.equal(gradients[0], gradient) for gradient in gradients[1:])
