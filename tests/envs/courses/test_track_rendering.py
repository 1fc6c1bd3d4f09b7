"""Pictures of tracks and robots."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.record import PixelRenderTransform

from afm_rl.envs import TrackCanvas, UGVTrack, load_track
from afm_rl.envs.courses.rendering import robot_outline
from afm_rl.errors import AFMError, ConfigurationError


def test_the_robot_points_along_its_heading():
    corners = robot_outline(torch.tensor([2.0, 1.0, math.pi / 2]))
    torch.testing.assert_close(corners[0], torch.tensor([2.0, 1.6]))


@pytest.mark.parametrize("name", ["ethz_1", "ethz_2"])
def test_a_picture_is_in_blocks_of_sixteen_pixels(name):
    frame = TrackCanvas(load_track(name), pixels=320).draw(torch.zeros(3), torch.zeros(2))
    assert max(frame.shape) == 320 and frame.shape[0] % 16 == frame.shape[1] % 16 == 0


def test_a_canvas_forgets_what_it_drew():
    canvas = TrackCanvas(load_track("ethz_2"), pixels=160)
    here, there = torch.zeros(3), torch.tensor([5.0, 0.0, 1.0])
    first = canvas.draw(here, torch.ones(2))
    other = canvas.draw(there, torch.ones(2), trail=torch.randn(9, 3))
    assert (first != other).any()
    assert (canvas.draw(here, torch.ones(2)) == first).all()


def test_the_robot_is_drawn_where_it_is():
    canvas = TrackCanvas(load_track("ethz_2"), pixels=320)
    blue = [
        (canvas.draw(torch.tensor([x, 0.0, 0.0]), torch.tensor([50.0, 50.0])) == (0, 114, 178))
        for x in (-6.0, 6.0)
    ]
    left, right = (np.argwhere(seen.all(-1))[:, 1].mean() for seen in blue)
    half = canvas.draw(torch.zeros(3), torch.zeros(2)).shape[1] / 2
    assert left < half < right
    assert left + right == pytest.approx(2 * half, abs=3)


def test_the_environment_draws_the_first_mission():
    env = UGVTrack(["ethz_1", "ethz_2"], start_noise=0.0)
    with pytest.raises(AFMError, match="call reset"):
        env.render()
    env.reset(torch.stack([env.mission(1), env.mission(0)]), set_state=False)
    frame = env.render(mode="rgb_array")
    single = env.reset(env.mission(1), set_state=False)
    assert (frame == env.render()).all()
    assert (frame == env.render(single)).all()
    with pytest.raises(ConfigurationError, match="mode='human'"):
        env.render(mode="human")
    with pytest.raises(AFMError, match="call reset"):
        env.render(TensorDict(batch_size=[0]))


def test_torchrl_records_pixels():
    env = TransformedEnv(UGVTrack(), PixelRenderTransform(mode="rgb_array"))
    pixels = env.rollout(3)["pixels"]
    assert pixels.dtype is torch.uint8 and pixels.shape[::3] == (3, 3)
