"""Weights from the zip file of a saved model, and nothing else of it."""

from __future__ import annotations

import io
import zipfile
from os import PathLike
from pathlib import Path
from typing import Any, Final

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.errors import ExportError

_ENTRY: Final = "policy.pth"
#: What a file of tensors may be longer than the tensors.
_OVERHEAD: Final = 1 << 22


def load_weights(model: BaseAlgorithm | BasePolicy, path: str | PathLike[str]) -> None:
    """
    Take the policy's weights from a model that ``save`` wrote, without running code from the file.

    SB3's own ``load`` unpickles the whole model, which lets a file from a stranger run anything. Here the caller makes
    the model (with the same ``policy_kwargs``), and the file gives numbers alone: ``torch.load`` with
    ``weights_only=True``, names, shapes and types compared with the model's first. The optimiser's state and the
    hyper-parameters are not read.

    :param model: an algorithm or a policy, changed only if all of the file fits
    :param path: the zip file, with or without ``.zip``
    :raises ExportError: if the file is damaged, malformed, or of a differently built policy
    """
    policy: Any = getattr(model, "policy", model)
    own: dict[str, th.Tensor] = policy.state_dict()
    limit = 2 * sum(tensor.numel() * tensor.element_size() for tensor in own.values()) + _OVERHEAD
    path = Path(path)
    path = path if path.is_file() else path.with_name(f"{path.name}.zip")
    tensors = _tensors(_entry(path, limit), limit, path)
    _check(own, tensors, path)
    policy.load_state_dict(tensors)


def _entry(path: Path, limit: int) -> bytes:
    """Return the policy's file in a model's zip."""
    if not path.is_file():
        raise ExportError(f"expected a model saved by Stable-Baselines3, found no file {path}")
    try:
        with zipfile.ZipFile(path) as archive, archive.open(_ENTRY) as file:
            data = file.read(limit + 1)  # counted while it is unpacked: a stated size may be wrong
    except Exception as error:  # a damaged zip may raise anything, zlib's and struct's errors included
        raise ExportError(f"{path} is not a model saved by Stable-Baselines3: {error}") from error
    if len(data) > limit:
        raise ExportError(f"{_ENTRY} in {path} has more than {limit} bytes, too many for the model's weights")
    return data


def _tensors(data: bytes, limit: int, path: Path) -> dict[str, th.Tensor]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(info.file_size for info in archive.infolist())
            packed = any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist())
        if packed or size > limit:
            raise ValueError("it unpacks to more than it is")
        tensors = th.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler's errors have no common class
        raise ExportError(f"{_ENTRY} in {path} does not hold tensors alone: {str(error)[:200]}") from error
    if not isinstance(tensors, dict):
        raise ExportError(f"{_ENTRY} in {path} must map names to tensors, got {type(tensors).__name__}")
    return tensors


def _check(own: dict[str, th.Tensor], tensors: dict[Any, Any], path: Path) -> None:
    if different := own.keys() ^ tensors.keys():
        name = min(map(str, different))
        has = "lacks" if name in own else "has, unlike the model,"
        raise ExportError(
            f"{path} {has} the weights {name[:80]!r}; make the model with the policy and policy_kwargs it was trained "
            "with"
        )
    for name, tensor in tensors.items():
        wanted = own[name]
        if not isinstance(tensor, th.Tensor) or tensor.layout != th.strided or tensor.is_quantized:
            raise ExportError(f"{path}: {name!r} is no plain tensor")
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise ExportError(
                f"{path}: expected {name!r} of shape {tuple(wanted.shape)} and {wanted.dtype}, got "
                f"{tuple(tensor.shape)} and {tensor.dtype}; make the model with the policy_kwargs it was trained with"
            )
        if not bool(tensor.isfinite().all()):
            raise ExportError(f"{path}: {name!r} has NaN or infinity")
