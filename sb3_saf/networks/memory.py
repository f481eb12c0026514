"""
Memory over the steps of an episode: a GRU or an LSTM.

On the CPU, gates are computed by compiled loops, which also empty the memory where episodes begin. PyTorch's own, which
run from one beginning to the next, take twice as long.

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

from hecogrid_envs.core.jit import cached
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
        if not twice and _can_be_compiled(inputs):
            memories = self._compiled(inputs, memory, starts)
            return memories[:, :, : self.rnn.hidden_size], memories[-1]
        if not twice:
            return self._from_start_to_start(inputs, memory, starts)
        with th.backends.cudnn.flags(enabled=False):  # it has no second derivatives
            return self._from_start_to_start(inputs, memory, starts)

    def _compiled(self, inputs: th.Tensor, memory: th.Tensor, starts: th.Tensor | None) -> th.Tensor:
        self.check_state(memory, inputs.shape[1])  # the kernels do not look
        of_input, of_memory, input_bias, memory_bias = self.rnn.parameters()
        of_inputs = nn.functional.linear(inputs, of_input, input_bias)
        memories: th.Tensor = _Recurrence.apply(of_inputs, memory, starts, of_memory, memory_bias)
        return memories

    def check_state(self, memory: th.Tensor, n_rows: int) -> None:
        """Raise a ValueError unless there is a memory for each row."""
        if memory.shape != (shape := (n_rows, self.state_dim)):
            raise ValueError(
                f"expected a state of shape {shape}, a row for each observation, got {tuple(memory.shape)}; pass the "
                "state that was returned for these rows, or None where episodes begin"
            )

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
        """Run over one step: :meth:`forward` without the axis T."""
        outputs, memory = self(inputs.unsqueeze(0), memory, None if starts is None else starts.unsqueeze(0))
        return outputs.squeeze(0), memory

    def every(self, inputs: th.Tensor, memory: th.Tensor, starts: th.Tensor) -> th.Tensor:
        """
        Run over successive steps; arguments as in :meth:`forward`.

        :return: memory (T, R, M) after every step, which begins with the outputs (T, R, H)
        """
        if _can_be_compiled(inputs):
            return self._compiled(inputs, memory, starts)
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


def _can_be_compiled(inputs: th.Tensor) -> bool:
    return inputs.device.type == "cpu" and inputs.dtype == th.float32 and not th.compiler.is_compiling()


class _Recurrence(th.autograd.Function):
    """
    Memory (T, R, M) after every step, from the inputs' part of the gates, (T, R, 3 H) or, of an LSTM, (T, R, 4 H).

    With x of the inputs and h of the memory, W h + b, and an empty memory where an episode begins:

    - GRU: r = sigmoid(x_r + h_r), z = sigmoid(x_z + h_z), n = tanh(x_n + r h_n), h' = (1 - z) n + z h
    - LSTM: i, f, o = sigmoid(x + h), g = tanh(x_g + h_g), c' = f c + i g, h' = o tanh(c')
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
        of_inputs, (length, n_rows, n_gates), size = of_inputs.contiguous(), of_inputs.shape, weight.shape[1]
        starts = of_inputs.new_zeros(length, n_rows, dtype=th.bool) if starts is None else starts.contiguous()
        before, after = of_inputs.new_empty(2, length, *memory.shape)
        gates, of_memory = of_inputs.new_empty(length, n_rows, 4 * size), of_inputs.new_empty(n_rows, n_gates)
        arrays = [part.detach().numpy() for part in (of_inputs, before, gates, after)]
        kernel, transposed = _gru if n_gates == 3 * size else _lstm, weight.t()
        for step in range(length):
            before[step] = memory.masked_fill(starts[step].unsqueeze(1), 0.0)
            th.addmm(bias, before[step, :, :size], transposed, out=of_memory)
            kernel(of_memory.numpy(), *[array[step] for array in arrays])
            memory = after[step]
        ctx.save_for_backward(before, gates, after, starts, weight)
        return after

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[Any, ...]:
        before, gates, after, starts, weight = ctx.saved_tensors
        gradient, (n_gates, size) = gradients[0].clone(memory_format=th.contiguous_format), weight.shape
        of_inputs, earlier = before.new_empty(*before.shape[:2], n_gates), th.zeros_like(before[0])
        # Gradients of the memory's parts of the gates: in a GRU, the candidate's is multiplied by the reset gate.
        parts, saved, kernel = [of_inputs], [gradient, before, gates, after, of_inputs], _lstm_back
        if n_gates == 3 * size:
            parts = [of_inputs[:, :, : 2 * size], th.empty_like(before)]
            saved, kernel = [gradient, before, gates, of_inputs, parts[1]], _gru_back
        weights = weight.split([part.shape[2] for part in parts])
        arrays = [part.numpy() for part in saved]
        for step in reversed(range(len(before))):
            gradient[step] += earlier
            kernel(*[array[step] for array in arrays], earlier.numpy())
            for part, weight_of_part in zip(parts, weights, strict=True):
                earlier[:, :size].addmm_(part[step], weight_of_part)
            earlier.masked_fill_(starts[step].unsqueeze(1), 0.0)
        flat, hidden = [part.flatten(0, 1) for part in parts], before[:, :, :size].flatten(0, 1)
        of_weight = th.cat([part.t() @ hidden for part in flat])
        return of_inputs, earlier, None, of_weight, th.cat([part.sum(dim=0) for part in flat])


Floats = npt.NDArray[np.float32]
_ONE, _HALF = np.float32(1.0), np.float32(0.5)

# The kernels' loops are short and over few arrays, so that they are vectorised.


@cached(error_model="numpy", fastmath={"contract"})
def _gru(of_memory: Floats, of_inputs: Floats, before: Floats, gates: Floats, after: Floats) -> None:
    """Compute [r, z, n, h_n] (R, 4 H) and h' (R, H)."""
    n_rows, size = before.shape
    for row in range(n_rows):
        for i in range(2 * size):
            gates[row, i] = _HALF + _HALF * tanh_of(_HALF * (of_inputs[row, i] + of_memory[row, i]))
        for i in range(2 * size, 3 * size):
            gates[row, size + i] = of_memory[row, i]
        for i in range(size):
            j = 2 * size + i
            gates[row, j] = tanh_of(of_inputs[row, j] + gates[row, i] * of_memory[row, j])
        for i in range(size):
            n = gates[row, 2 * size + i]
            after[row, i] = n + gates[row, size + i] * (before[row, i] - n)


@cached(error_model="numpy", fastmath={"contract"})
def _gru_back(
    gradient: Floats, before: Floats, gates: Floats, of_inputs: Floats, of_candidate: Floats, earlier: Floats
) -> None:
    """Compute the gradients of x (R, 3 H) and h_n (R, H), and the direct one of h (R, H), from that of h'."""
    n_rows, size = before.shape
    for row in range(n_rows):
        for i in range(size):
            earlier[row, i] = gradient[row, i] * gates[row, size + i]
        for i in range(size):
            z, n = gates[row, size + i], gates[row, 2 * size + i]
            of_inputs[row, 2 * size + i] = gradient[row, i] * (_ONE - z) * (_ONE - n * n)
        for i in range(size):
            z, n = gates[row, size + i], gates[row, 2 * size + i]
            of_inputs[row, size + i] = gradient[row, i] * (before[row, i] - n) * z * (_ONE - z)
        for i in range(size):
            r = gates[row, i]
            of_inputs[row, i] = of_inputs[row, 2 * size + i] * gates[row, 3 * size + i] * r * (_ONE - r)
        for i in range(size):
            of_candidate[row, i] = of_inputs[row, 2 * size + i] * gates[row, i]


@cached(error_model="numpy", fastmath={"contract"})
def _lstm(of_memory: Floats, of_inputs: Floats, before: Floats, gates: Floats, after: Floats) -> None:
    """Compute the gates [i, f, g, o] (R, 4 H) and [h', c'] (R, 2 H)."""
    n_rows, size = len(before), before.shape[1] // 2
    for row in range(n_rows):
        for i in range(4 * size):
            gates[row, i] = of_inputs[row, i] + of_memory[row, i]
        for i in range(2 * size):
            gates[row, i] = _HALF + _HALF * tanh_of(_HALF * gates[row, i])
        for i in range(2 * size, 3 * size):
            gates[row, i] = tanh_of(gates[row, i])
        for i in range(3 * size, 4 * size):
            gates[row, i] = _HALF + _HALF * tanh_of(_HALF * gates[row, i])
        for i in range(size):
            new = gates[row, i] * gates[row, 2 * size + i]
            after[row, size + i] = gates[row, size + i] * before[row, size + i] + new
        for i in range(size):
            after[row, i] = gates[row, 3 * size + i] * tanh_of(after[row, size + i])


@cached(error_model="numpy", fastmath={"contract"})
def _lstm_back(
    gradient: Floats, before: Floats, gates: Floats, after: Floats, of_inputs: Floats, earlier: Floats
) -> None:
    """Compute the gradients of the parts of the gates (R, 4 H), and the direct one of [h, c], from that of [h', c']."""
    n_rows, size = len(before), before.shape[1] // 2
    for row in range(n_rows):
        for i in range(size):
            t, o = tanh_of(after[row, size + i]), gates[row, 3 * size + i]
            of_inputs[row, 3 * size + i] = gradient[row, i] * t * o * (_ONE - o)
        for i in range(size):
            t = tanh_of(after[row, size + i])
            gradient[row, size + i] += gradient[row, i] * gates[row, 3 * size + i] * (_ONE - t * t)
        for i in range(size):
            gate, g = gates[row, i], gates[row, 2 * size + i]
            of_inputs[row, i] = gradient[row, size + i] * g * gate * (_ONE - gate)
        for i in range(size):
            f = gates[row, size + i]
            of_inputs[row, size + i] = gradient[row, size + i] * before[row, size + i] * f * (_ONE - f)
        for i in range(size):
            g = gates[row, 2 * size + i]
            of_inputs[row, 2 * size + i] = gradient[row, size + i] * gates[row, i] * (_ONE - g * g)
        for i in range(size):
            earlier[row, i] = np.float32(0.0)
        for i in range(size):
            earlier[row, size + i] = gradient[row, size + i] * gates[row, size + i]
