"""Weights of a policy as safetensors, and out of the zip file of a saved model."""

from __future__ import annotations

import io
import zipfile
from os import PathLike
from pathlib import Path
from typing import Any

import torch as th
from safetensors.torch import load, save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.teams.checks import ExportError
from sb3_saf.teams.files import atomic_file


def save_weights(model: BaseAlgorithm | BasePolicy, path: str | PathLike[str]) -> Path:
    """
    Write the policy's weights as safetensors, atomically; :func:`load_weights` reads them.

    :param model: an algorithm or a policy
    :param path: the file; ``.safetensors`` is appended if missing
    :return: the file
    """
    path = Path(path)
    path = path if path.suffix == ".safetensors" else path.with_name(f"{path.name}.safetensors")
    policy: Any = getattr(model, "policy", model)
    tensors = policy.state_dict()
    names = set(_first_names(tensors).values())
    content = save({name: tensor.contiguous() for name, tensor in tensors.items() if name in names})
    with atomic_file(path) as file:
        file.write(content)
    return path


def load_weights(model: BaseAlgorithm | BasePolicy, path: str | PathLike[str]) -> None:
    """
    Load the weights of a policy, without running code from the file.

    SB3's ``load`` unpickles the whole model, so an untrusted file can run arbitrary code. Here the caller makes the
    model (with the same ``policy_kwargs``), and only tensors are read. The optimiser's state and the hyperparameters
    are not read.

    :param model: an algorithm or a policy, changed only if the whole file matches
    :param path: the file of :func:`save_weights`, or the zip file of SB3's ``save``, with or without ``.zip``
    :raises ExportError: if the file is damaged, malformed, or of a differently built policy
    """
    policy: Any = getattr(model, "policy", model)
    own: dict[str, th.Tensor] = policy.state_dict()
    path = Path(path)
    path = path if path.is_file() or path.suffix in (".zip", ".safetensors") else path.with_name(f"{path.name}.zip")
    tensors = read_weights(path)
    if path.suffix == ".safetensors":  # each tensor is stored under the first of its names
        tensors |= {name: tensors[first] for name, first in _first_names(own).items() if first in tensors}
    fix = "; make the model with the policy and policy_kwargs it was trained with"
    if missing := sorted(own.keys() - tensors.keys()):
        raise ExportError(f"{path} lacks the tensor {missing[0]!r}{fix}")
    if unknown := sorted(map(str, tensors.keys() - own.keys())):
        raise ExportError(f"{path} has a tensor that the network does not have: {unknown[0][:80]!r}{fix}")
    for name, expected in own.items():
        tensor = tensors[name]
        if not isinstance(tensor, th.Tensor) or (tensor.shape, tensor.dtype) != (expected.shape, expected.dtype):
            is_tensor = isinstance(tensor, th.Tensor)
            got = f"{tuple(tensor.shape)} and {tensor.dtype}" if is_tensor else type(tensor).__name__
            raise ExportError(
                f"{path}: expected {name!r} of shape {tuple(expected.shape)} and {expected.dtype}, got {got}{fix}"
            )
        if not bool(tensor.isfinite().all()):
            raise ExportError(f"{path}: {name!r} has NaN or infinity")
    policy.load_state_dict(tensors)


def _first_names(tensors: dict[str, th.Tensor]) -> dict[str, str]:
    """Return for every tensor the first name of the same memory: modules may be shared."""
    first: dict[tuple[Any, ...], str] = {}
    return {
        name: first.setdefault((tensor.data_ptr(), tensor.shape) if tensor.numel() else (name,), name)
        for name, tensor in tensors.items()
    }


def read_weights(path: Path) -> dict[str, th.Tensor]:
    """
    Return the weights in a file of safetensors or of a saved model; only tensors are read.

    :raises ExportError: if the file is missing, damaged, or has other content
    """
    if not path.is_file():
        raise ExportError(f"expected a model saved by Stable-Baselines3 or its weights, found no file {path}")
    try:
        if path.suffix == ".safetensors":
            return load(path.read_bytes())
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} in it is damaged")
            data = archive.read("policy.pth")
        tensors = th.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # zips, the unpickler and safetensors have no common class of errors
        raise ExportError(f"{path} does not hold the tensors of a saved model: {str(error)[:200]}") from error
    if not isinstance(tensors, dict):
        raise ExportError(f"{path} must map names to tensors, got {type(tensors).__name__}")
    return tensors
