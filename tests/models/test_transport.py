"""PointNet and photon network against float64 NumPy, and what masking and permuting may change."""

import numpy as np
import torch

from nlt.models.transport import PhotonNetwork, PointEmbedding, PointNet

IN, N = 7, 30


def weights(module):
    return {name: p.detach().double().numpy() for name, p in module.named_parameters()}


def linear(w, name, x):
    return x @ w[f"{name}.weight"].T + w.get(f"{name}.bias", 0)


def residual(w, name, x):
    hidden = linear(w, f"{name}.fc_0", np.maximum(x, 0))
    shortcut = linear(w, f"{name}.shortcut", x) if f"{name}.shortcut.weight" in w else x
    return shortcut + linear(w, f"{name}.fc_1", np.maximum(hidden, 0))


def network():
    torch.manual_seed(0)
    visible = torch.rand(2, N) < 0.6
    return PointNet(IN).eval(), torch.randn(2, N, IN), visible


def test_pointnet_equals_numpy():
    net, points, visible = network()
    w = weights(net)
    for b in range(2):
        x = linear(w, "preprocess", points[b].double().numpy())
        for block in ("blocks.0", "blocks.1"):
            local = residual(w, block, x)
            assert local.shape == (N, 32)
            largest = local[visible[b].numpy()].max(axis=0)
            x = np.concatenate([local, np.broadcast_to(largest, local.shape)], axis=1)
        np.testing.assert_allclose(net(points, visible)[b].detach().numpy(), x, atol=1e-5)


def test_invisible_points_change_nothing_for_the_others():
    net, points, visible = network()
    changed = torch.where(visible[..., None], points, 100 * torch.randn(points.shape))
    assert torch.equal(net(points, visible)[visible], net(changed, visible)[visible])


def test_permutation_equivariance():
    net, points, visible = network()
    order = torch.randperm(N)
    torch.testing.assert_close(net(points, visible)[:, order], net(points[:, order], visible[:, order]))


def test_no_visible_point():
    """Output and gradients are finite, and the other sample of the batch is not disturbed."""
    net, points, visible = network()
    expected = net(points, visible)[1]
    visible[0] = False
    result = net(points, visible)
    result.sum().backward()
    assert result.isfinite().all() and torch.equal(result[1], expected)
    assert all(p.grad.isfinite().all() for p in net.parameters())


def test_photon_network_equals_numpy():
    torch.manual_seed(0)
    net, photons = PhotonNetwork(9), torch.randn(2, N, 9)
    w = weights(net)
    x = linear(w, "0", photons.double().numpy())
    for block in ("1", "2"):
        x = residual(w, block, x)
    assert x.shape == (2, N, 64)
    np.testing.assert_allclose(net(photons).detach().numpy(), x, atol=1e-5)
    order = torch.randperm(N)
    torch.testing.assert_close(net(photons)[:, order], net(photons[:, order]))


def test_embedding_is_per_scene_and_point():
    embedding = PointEmbedding(num_scenes=3, num_points=4, channels=5)
    result = embedding(torch.tensor([2, 0]))
    assert result.shape == (2, 4, 5)
    assert torch.equal(result[0], embedding.table.weight[8:12])
    assert torch.equal(result[1], embedding.table.weight[:4])
