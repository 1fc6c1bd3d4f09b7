"""Every public module on a GPU: where there is none, on one without numbers."""

import pytest
import torch
from fake_gpu import DEVICE, FakeGPU

LEARNING = {"updater.forward", "updater.follow"}  # the latter where missions have changed
WAITING = {  # what waits for the device at a step, see docs/howto/gpu.md
    "MPC": {"mpc._choose", "mpc.plan", "riccati.solve_lq"},
    "RLSUpdater": LEARNING,
    **dict.fromkeys(("OnlineUpdater", "StreamXUpdater", "UnmatchedUpdater"), LEARNING),
}


def parts_of(module):
    """Return a module, and the one that it shares with others, if it does."""
    shared = getattr(module, "model", None)
    return [module] if shared is None else [module, shared]


def waits(case, answer):
    """Run a module; return where it waits for the device."""
    module = case.make()
    with FakeGPU(answer) as gpu:
        gpu.move(*parts_of(module))
        if hasattr(module, "start"):
            module.start()
        said = case.say(module, (4,), device=DEVICE)
        assert all(part.device == DEVICE for part in said)
        return set(gpu.waits)


def test_a_module_stays_on_its_device_and_waits_for_it_only_where_it_must(movable_case):
    name, case = movable_case
    found = waits(case, answer=False)
    if found:  # then there is another branch
        found |= waits(case, answer=True)
    assert found == WAITING.get(name, set())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_it_says_the_same_on_a_gpu(movable_case):
    _, case = movable_case
    double = {"dtype": torch.float64}  # in single precision, fits differ by rounding
    expected = case.say(case.make(**double), (4,), device="cpu", **double)
    module = case.make(**double)
    for part in parts_of(module):
        part.to("cuda")
    found = case.say(module, (4,), device="cuda", **double)
    for one, other in zip(found, expected, strict=True):
        assert one.is_cuda
        torch.testing.assert_close(one.cpu(), other, rtol=1e-5, atol=1e-6)
