"""A policy from an ONNX file that need not be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from afm_rl.errors import ArtefactError, refusing
from afm_rl.imports import check_installed
from afm_rl.planning.onnx_file import NO_POLICY, TYPES, open_session, read_graph
from afm_rl.storage.child import in_child


class GraphPolicy(nn.Module):
    """A policy as an ONNX graph; made by :func:`policy_from_onnx`.

    Args:
        name: of the file.
        session: runs the graph.
        inputs: the graph's inputs, with shape and type, in the order of an observation's numbers.
        output: the graph's output with the action.
    """

    session: Any

    def __init__(
        self, name: str, session: Any, inputs: dict[str, tuple[list[int], Any]], output: str
    ):
        super().__init__()
        self.__dict__["session"] = session
        self.name, self.inputs, self.output = name, inputs, output
        self.sizes = [math.prod(shape) for shape, _ in inputs.values()]
        self.observation_size = sum(self.sizes)
        self.action_size = len(self(torch.zeros(self.observation_size)))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` for an observation ``(*B, O)``, row by row.

        Raises:
            ArtefactError: if the graph fails, for example by an index out of range.
        """
        rows = observation.detach().reshape(-1, self.observation_size).cpu()
        actions = []
        for row in rows:
            given = {}
            for part, (name, (shape, kind)) in zip(
                row.split(self.sizes), self.inputs.items(), strict=True
            ):
                given[name] = part.numpy().astype(kind).reshape(shape)
            with refusing(f"{self.name}: no action for this observation", ArtefactError):
                (action,) = self.session.run([self.output], given)
            actions.append(torch.as_tensor(action).flatten())
        found = torch.stack(actions).to(observation)
        return found.view(*observation.shape[:-1], -1)


def policy_from_onnx(
    path: str | Path, inputs: Sequence[str] | None = None, output: str | None = None
) -> GraphPolicy:
    """Return the policy in an ONNX file, a function of observations ``(*B, O)``.

    The file need not be trusted. These conditions are checked before it is run: all operators are
    those of ONNX, without loops and branches; weights are in the file or in files of its folder;
    every result has a known size of at most 2^24 numbers; and an action takes at most 2^31 products
    and sums. A child process, limited to 5 s of work and 2 GiB, opens the file first, because a
    file can crash the libraries that open it. A recurrent policy, whose state is an input and an
    output, is refused, because it would not know when an episode begins.

    Args:
        path: the file.
        inputs: names of its inputs, in the order of the observation; required if there are
            several.
        output: the one that is the action; None: the first.

    Raises:
        ConfigurationError: if there is no such file, input or output, or onnxruntime is missing.
        ArtefactError: if it holds no such policy.

    Example::

        policy = policy_from_onnx("go1_policy.onnx")
        action = policy(observation)
    """
    packages = ["onnx", "onnxruntime"]
    check_installed("ONNX", *packages, extra="onnx")
    file, said = str(path), f"{path}: {NO_POLICY}"
    names = None if inputs is None else list(inputs)
    code = in_child(said, read_graph, file, names, output, packages=packages, kind=ArtefactError)
    with refusing(said, ArtefactError):
        session = open_session(code)
        found = {x.name: (x.shape, TYPES[x.type]) for x in session.get_inputs()}
        ordered = {name: found[name] for name in names or found}
        return GraphPolicy(file, session, ordered, output or session.get_outputs()[0].name)
