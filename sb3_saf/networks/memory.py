"""
Memory over the steps of an episode: a GRU or an LSTM.

On the CPU, a GRU's gates are computed by compiled loops, which also empty the memory where episodes begin. PyTorch's
GRU, which runs from one beginning to the next, takes twice as long.

Letters: T steps, R rows (agents or teams), d inputs, H outputs, M size of a row's memory.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_saf.networks.compiled import cached
from sb3_saf.networks.tanh import tanh_of

MemoryName = Literal["gru", "lstm"]
MEMORY_NAMES: Final[tuple[MemoryName, ...]] = get_args(MemoryName)


class Memory(nn.Module):
    """
    GRU or LSTM over the steps of an episode.

    The memory of a row is one vector, zeros where its episode begins: h of a GRU (M = H), h and c of an LSTM (M = 2 H).

    :param kind: ``"gru"`` or ``"lstm"``
    :param inputs_dim: d
    :param size: H
    """

    def __init__(self, kind: MemoryName, inputs_dim: int, size: int):
        super().__init__()
        self.rnn: nn.GRU | nn.LSTM = nn.GRU(inputs_dim, size) if kind == "gru" else nn.LSTM(inputs_dim, size)
        self.state_dim = size if kind == "gru" else 2 * size

    def forward(
        self, inputs: th.Tensor, memory: th.Tensor, starts: th.Tensor | None = None, twice: bool = False
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Run over successive steps.

        :param inputs: (T, R, d)
        :param memory: (R, M) memory before the first step
        :param starts: (T, R) bool, where an episode begins, which empties the memory before the step; None for nowhere
        :param twice: whether the result must be differentiable twice, as TRPO needs
        :return: outputs (T, R, H), and the memory (R, M) after the last step
        """
        on_cpu = inputs.device.type == "cpu" and inputs.dtype == th.float32 and not th.compiler.is_compiling()
        if isinstance(self.rnn, nn.GRU) and on_cpu and not twice:
            of_input, of_memory, input_bias, memory_bias = self.rnn.parameters()
            of_inputs = nn.functional.linear(inputs, of_input, input_bias)
            outputs: th.Tensor = _GRU.apply(of_inputs, memory, starts, of_memory, memory_bias)
            return outputs, outputs[-1]
        if not twice:
            return self._from_start_to_start(inputs, memory, starts)
        with th.backends.cudnn.flags(enabled=False):  # it has no second derivatives
            return self._from_start_to_start(inputs, memory, starts)

    def _from_start_to_start(
        self, inputs: th.Tensor, memory: th.Tensor, starts: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        if starts is None:
            return self._run(inputs, memory)
        begins = [step for step in starts.any(dim=1).nonzero().flatten().tolist() if step]
        outputs = []
        for first, last in pairwise([0, *begins, len(inputs)]):
            memory = memory.masked_fill(starts[first].unsqueeze(1), 0.0)
            output, memory = self._run(inputs[first:last], memory)
            outputs.append(output)
        return th.cat(outputs), memory

    def step(
        self, inputs: th.Tensor, memory: th.Tensor, starts: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Run over one step.

        :param inputs: (R, d)
        :param memory: (R, M) memory before the step
        :param starts: (R,) bool, where an episode begins
        :return: outputs (R, H), and the memory (R, M) after the step
        """
        outputs, memory = self(inputs.unsqueeze(0), memory, None if starts is None else starts.unsqueeze(0))
        return outputs.squeeze(0), memory

    def every(self, inputs: th.Tensor, memory: th.Tensor, starts: th.Tensor) -> th.Tensor:
        """
        Run over successive steps; arguments as in :meth:`forward`.

        :return: memory (T, R, M) after every step, which begins with the outputs (T, R, H)
        """
        if isinstance(self.rnn, nn.GRU):
            return self(inputs, memory, starts)[0]
        memories = []
        for step, begins in zip(inputs, starts, strict=True):
            _, memory = self.step(step, memory, begins)
            memories.append(memory)
        return th.stack(memories)

    def _run(self, inputs: th.Tensor, memory: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        if isinstance(self.rnn, nn.GRU):
            outputs, hidden = self.rnn(inputs, memory.unsqueeze(0))
            return outputs, hidden.squeeze(0)
        hidden, cell = (part.contiguous().unsqueeze(0) for part in memory.chunk(2, dim=1))
        outputs, after = self.rnn(inputs, (hidden, cell))
        return outputs, th.cat(after, dim=2).squeeze(0)

    def orthogonal_init(self) -> None:
        """Initialise the weights of each gate orthogonally and the biases with zeros, as published MAPPO does."""
        for name, parameter in self.rnn.named_parameters():
            if "weight" in name:
                for gate in parameter.data.split(self.rnn.hidden_size):
                    nn.init.orthogonal_(gate)
            else:
                nn.init.zeros_(parameter)


class _GRU(th.autograd.Function):
    """
    The recurrence of a GRU, from its inputs' part of the gates (T, R, 3 H): reset r, update z, candidate n.

    r = sigmoid(x_r + h_r), z = sigmoid(x_z + h_z), n = tanh(x_n + r h_n), h' = (1 - z) n + z h, with
    [h_r, h_z, h_n] = W h + b, and h = 0 where an episode begins.
    """

    @staticmethod
    def forward(
        ctx: Any,
        of_inputs: th.Tensor,
        memory: th.Tensor,
        starts: th.Tensor | None,
        weight: th.Tensor,
        bias: th.Tensor,
    ) -> th.Tensor:
        of_inputs, (length, n_rows, _), size = of_inputs.contiguous(), of_inputs.shape, memory.shape[1]
        starts = of_inputs.new_zeros(length, n_rows, dtype=th.bool) if starts is None else starts.contiguous()
        before, after = of_inputs.new_empty(2, length, n_rows, size)
        of_memory, gates = of_inputs.new_empty(2, length, n_rows, 3 * size)
        transposed, arrays = (
            weight.t(),
            [part.detach().numpy() for part in (of_inputs, of_memory, before, gates, after)],
        )
        for step in range(length):
            before[step] = memory.masked_fill(starts[step].unsqueeze(1), 0.0)
            th.addmm(bias, before[step], transposed, out=of_memory[step])
            _step(*(array[step] for array in arrays))
            memory = after[step]
        ctx.save_for_backward(before, of_memory, gates, starts, weight)
        return after

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[Any, ...]:
        before, of_memory, gates, starts, weight = ctx.saved_tensors
        gradient, (length, n_rows, size) = gradients[0].clone(memory_format=th.contiguous_format), before.shape
        of_inputs, of_gates = before.new_empty(2, length, n_rows, 3 * size)
        later, following = before.new_zeros(n_rows, size), before.new_zeros(n_rows, size)
        over_time = [part.numpy() for part in (gradient, before, of_memory, gates, of_inputs, of_gates)]
        of_step = [later.numpy(), following.numpy()]
        for step in reversed(range(length)):
            _back(*[array[step] for array in over_time], *of_step)
            th.addmm(following, of_gates[step], weight, out=later)
            later.masked_fill_(starts[step].unsqueeze(1), 0.0)
        flat = of_gates.flatten(0, 1)
        return of_inputs, later, None, flat.t() @ before.flatten(0, 1), flat.sum(dim=0)


Floats = npt.NDArray[np.float32]
_ONE, _HALF = np.float32(1.0), np.float32(0.5)


@cached(error_model="numpy", fastmath={"contract"})
def _step(of_inputs: Floats, of_memory: Floats, before: Floats, gates: Floats, after: Floats) -> None:
    """Compute the gates [r, z, n] (R, 3 H) and h' (R, H)."""
    n_rows, size = before.shape
    for row in range(n_rows):
        # Short loops over few arrays are vectorised.
        for i in range(2 * size):
            gates[row, i] = _HALF + _HALF * tanh_of(_HALF * (of_inputs[row, i] + of_memory[row, i]))
        for i in range(size):
            j = 2 * size + i
            gates[row, j] = tanh_of(of_inputs[row, j] + gates[row, i] * of_memory[row, j])
        for i in range(size):
            n = gates[row, 2 * size + i]
            after[row, i] = n + gates[row, size + i] * (before[row, i] - n)


@cached(error_model="numpy", fastmath={"contract"})
def _back(
    gradient: Floats,
    before: Floats,
    of_memory: Floats,
    gates: Floats,
    of_inputs: Floats,
    of_gates: Floats,
    later: Floats,
    direct: Floats,
) -> None:
    """
    Compute the gradients of the parts of the gates (R, 3 H), and the direct one of h (R, H), from those of h'.

    :param later: (R, H) gradient of h' by later steps; ``gradient`` is that by the output, and becomes the sum
    """
    n_rows, size = before.shape
    for row in range(n_rows):
        for i in range(size):
            gradient[row, i] += later[row, i]
        for i in range(size):
            direct[row, i] = gradient[row, i] * gates[row, size + i]
        for i in range(size):
            z, n = gates[row, size + i], gates[row, 2 * size + i]
            of_inputs[row, 2 * size + i] = gradient[row, i] * (_ONE - z) * (_ONE - n * n)
        for i in range(size):
            z, n = gates[row, size + i], gates[row, 2 * size + i]
            of_inputs[row, size + i] = gradient[row, i] * (before[row, i] - n) * z * (_ONE - z)
        for i in range(size):
            r, j = gates[row, i], 2 * size + i
            of_inputs[row, i] = of_inputs[row, j] * of_memory[row, j] * r * (_ONE - r)
        for i in range(2 * size):
            of_gates[row, i] = of_inputs[row, i]
        for i in range(size):
            of_gates[row, 2 * size + i] = of_inputs[row, 2 * size + i] * gates[row, i]
