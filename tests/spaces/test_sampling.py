"""Points drawn uniformly in a box, or from a pool."""

import torch

from afm_rl.spaces.manifold import draw_states, uniform


def test_points_fill_their_box_evenly():
    low, high = torch.tensor([-1.0, 5.0]), torch.tensor([3.0, 5.5])
    points = uniform(low, high, 20_000, torch.Generator().manual_seed(0))
    assert points.shape == (20_000, 2)
    assert (points >= low).all() and (points <= high).all()
    torch.testing.assert_close(points.mean(0), (low + high) / 2, rtol=0, atol=0.03)
    torch.testing.assert_close(points.std(0), (high - low) / 12**0.5, rtol=0.02, atol=0)


def test_the_generator_alone_decides():
    low, high = torch.zeros(1), torch.ones(1)
    drawn = []
    for seed in (3, 3, 4):
        torch.rand(seed)  # must not matter
        drawn.append(uniform(low, high, 50, torch.Generator().manual_seed(seed)))
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])


def test_states_come_from_a_pool_or_a_box():
    pool = torch.arange(10.0).unsqueeze(-1)
    drawn = draw_states(pool, 500, torch.Generator().manual_seed(0))
    assert drawn.shape == (500, 1) and drawn.unique().tolist() == list(range(10))
    box = torch.zeros(1), torch.ones(1)
    same = [torch.Generator().manual_seed(1) for _ in range(2)]
    assert torch.equal(draw_states(box, 9, same[0]), uniform(*box, 9, same[1]))
