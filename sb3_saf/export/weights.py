"""Loading of weights only from the zip file of a saved model."""

from __future__ import annotations

import io
import zipfile
from os import PathLike
from pathlib import Path
from typing import Any, Final

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.export.network import check_tensors
from sb3_saf.teams.errors import ExportError

_ENTRY: Final = "policy.pth"
#: Maximum bytes of a file of tensors in addition to the tensors.
_OVERHEAD: Final = 1 << 22


def load_weights(model: BaseAlgorithm | BasePolicy, path: str | PathLike[str]) -> None:
    """
    Load the policy's weights of a model written by ``save``, without running code from the file.

    SB3's ``load`` unpickles the whole model, so an untrusted file can run arbitrary code. Here the caller makes the
    model (with the same ``policy_kwargs``), and only tensors are read: ``torch.load`` with ``weights_only=True``, after
    comparing names, shapes and types with the model's. The optimiser's state and the hyperparameters are not read.

    :param model: an algorithm or a policy, changed only if the whole file matches
    :param path: the zip file, with or without ``.zip``
    :raises ExportError: if the file is damaged, malformed, or of a differently built policy
    """
    policy: Any = getattr(model, "policy", model)
    own: dict[str, th.Tensor] = policy.state_dict()
    limit = 2 * sum(tensor.numel() * tensor.element_size() for tensor in own.values()) + _OVERHEAD
    path = Path(path)
    path = path if path.is_file() or path.suffix == ".zip" else path.with_name(f"{path.name}.zip")
    tensors = read_weights(path, limit)
    remedy = "; make the model with the policy and policy_kwargs it was trained with"
    check_tensors(own, tensors, str(path), remedy)
    policy.load_state_dict(tensors)


def read_weights(path: Path, limit: int = 1 << 31) -> dict[str, th.Tensor]:
    """
    Return the policy's weights in a model's file; only tensors are read.

    :param limit: maximum bytes of the weights
    :raises ExportError: if the file is damaged, malformed, or has other content
    """
    if not path.is_file():
        raise ExportError(f"expected a model saved by Stable-Baselines3, found no file {path}")
    try:
        with zipfile.ZipFile(path) as archive, archive.open(_ENTRY) as file:
            data = file.read(limit + 1)  # limited while unpacking: the stated size may be wrong
    except Exception as error:  # a damaged zip may raise many errors, including zlib's and struct's
        raise ExportError(f"{path} is not a model saved by Stable-Baselines3: {error}") from error
    if len(data) > limit:
        raise ExportError(f"{_ENTRY} in {path} has more than {limit} bytes, too many for the model's weights")
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
