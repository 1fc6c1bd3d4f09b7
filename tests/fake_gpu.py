"""A GPU that need not be there: its tensors have a shape and a device, but no numbers."""

import ctypes
import sys
import traceback
from pathlib import Path
from unittest import mock

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("cuda:0")
ATEN = torch.ops.aten
BY_INDEX = (ATEN.index.Tensor, ATEN.index_put.default, ATEN.index_put_.default)
CUDA, META = 1, 14  # numbers of kinds of devices in torch
PATIENCE = 12  # times that one place is given the same answer: then its loop shall end


class FakeGPU(TorchDispatchMode):
    """Runs what is inside on a device "cuda:0", which need not be there; tells where it waits.

    Mixed devices are an error, as on a GPU. Reading a number from the device gives ``answer``,
    so that both branches can be run; :attr:`waits` lists the reads. Gradients are zero: they are
    made by an engine that wants the device.
    """

    def __init__(self, answer=True):
        super().__init__()
        self.answer, self.waits = answer, []
        self.tensors = FakeTensorMode(allow_non_fake_inputs=False)
        self.engine = mock.patch("torch.autograd._engine_run_backward", _no_gradients)
        self.generators = mock.patch(
            "torch.Generator", lambda device="cpu", make=torch.Generator: make()
        )

    def __enter__(self):
        _lend_a_guard()
        _forget()
        self.engine.start()
        self.generators.start()
        self.tensors.__enter__()
        return super().__enter__()

    def __exit__(self, *reason):
        super().__exit__(*reason)
        self.tensors.__exit__(*reason)
        self.engine.stop()
        self.generators.stop()
        _forget()

    def move(self, *parts):
        """Move what has been made of numbers, in place."""
        self.tensors.allow_non_fake_inputs = True
        with mock.patch("torch.utils.swap_tensors", _swap):
            for part in parts:
                part.to(DEVICE)
        self.tensors.allow_non_fake_inputs = False

    def __torch_dispatch__(self, operation, types, arguments=(), settings=None):
        settings, arguments = dict(settings or {}), list(arguments)
        if _kind(settings) == "meta":  # where the guard is from
            settings["device"] = DEVICE
        first = arguments[0] if arguments else None
        if operation is ATEN.equal.default:
            return self._say(first)
        if operation is ATEN._local_scalar_dense.default:
            answer = self._say(first)
            return float(answer) if first.dtype.is_floating_point else int(answer)
        if operation is ATEN.nonzero.default:
            return torch.stack(self._rows(first), -1)
        if operation in BY_INDEX:
            parts = [
                self._rows(part) if part is not None and part.dtype is torch.bool else [part]
                for part in arguments[1]
            ]
            arguments[1] = [index for part in parts for index in part]
        if operation is ATEN._to_copy.default and first.is_cuda and _kind(settings) == "cpu":
            self._say(first)
        return operation(*arguments, **settings)

    def _say(self, asked):
        if not asked.is_cuda:
            return self.answer
        frames = [(Path(frame.filename), frame.name) for frame in traceback.extract_stack()]
        ours = [
            f"{path.stem}.{name}" for path, name in frames if {"afm_rl", "envs"} & {*path.parts}
        ]
        self.waits.append(ours[-1] if ours else "elsewhere")
        return self.answer if self.waits.count(self.waits[-1]) < PATIENCE else not self.answer

    def _rows(self, mask):
        """Return the indices where a mask is true, of each of its dimensions."""
        count = mask.numel() if self._say(mask) else 0
        return [torch.zeros(count, dtype=torch.int64, device=mask.device) for _ in mask.shape]


def _swap(one, other, swap=torch.utils.swap_tensors):
    """Swap tensors, unless a parameter was moved before: modules may share it."""
    if one.device != other.device:
        swap(one, other)


def _kind(settings):
    device = settings.get("device")
    return None if device is None else torch.device(device).type


def _no_gradients(outputs, grads, keep, create, inputs, *more, **settings):
    """Stand in for the engine that makes gradients."""
    if not settings.get("accumulate_grad"):
        return tuple(torch.zeros_like(tensor) for tensor in inputs)
    nodes, seen = [output.grad_fn for output in outputs], set()
    while nodes:
        node = nodes.pop()
        if node is not None and node not in seen:
            seen.add(node)
            nodes += [later for later, _ in node.next_functions]
            if hasattr(node, "variable"):
                node.variable.grad = torch.zeros_like(node.variable)


def _lend_a_guard():
    """Let a torch without CUDA index tensors that are said to be there.

    It asks the guard of the device, which is not there. That of tensors without numbers will do:
    it does nothing.
    """
    library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libc10.so"))
    name = "_ZN3c104impl26device_guard_impl_registryE"
    guards = (ctypes.c_void_p * (META + 1)).in_dll(library, name)
    guards[CUDA] = guards[CUDA] or guards[META]


def _forget():
    """Empty the caches of functions: what they keep has numbers, or lacks them."""
    for name, module in list(sys.modules.items()):
        if name.startswith("afm_rl"):
            for function in vars(module).values():
                if hasattr(function, "cache_clear"):
                    function.cache_clear()
