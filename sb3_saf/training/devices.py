"""Devices that are not there: Stable-Baselines3 would silently train on the CPU."""

from __future__ import annotations

import torch as th


def check_device(device: str) -> str:
    """
    Check that a device is there.

    :param device: as SB3 takes it: ``"auto"``, ``"cpu"``, ``"cuda"``, ``"cuda:1"``, ...
    :return: the same
    :raises ValueError: if there is no such device, with what is there
    """
    if device == "auto":
        return device
    try:
        wanted = th.device(device)
    except RuntimeError:
        raise ValueError(f"--device must be auto, cpu, cuda, cuda:1 or another of torch's, got {device!r}") from None
    if wanted.type == "cuda":
        count = th.cuda.device_count() if th.cuda.is_available() else 0
        if (wanted.index or 0) >= count:
            raise ValueError(
                f"--device {device} is not there: torch {th.__version__} sees {count or 'no'} CUDA device"
                f"{'' if count == 1 else 's'}; take --device cpu or auto, or check the driver (nvidia-smi) and that "
                "torch was built for CUDA (python -c 'import torch; print(torch.version.cuda)')"
            )
    elif wanted.type != "cpu":
        try:
            th.empty(1, device=wanted)
        except (RuntimeError, NotImplementedError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"--device {device} cannot be used here ({reason}); take --device cpu or auto") from None
    return device
