"""DINOv2 vision transformers (Oquab et al. 2023), with weights from Meta's own files.

The position embedding is resized once, to the one input size, the way the published code does it
(``interpolate_pos_encoding``): bicubic, for the models without registers by a scale factor with an offset of 0.1, for
those with registers antialiased to the exact size. It is then a constant of the network, which exports.
"""

from __future__ import annotations

import pickle
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.error import URLError

import torch
from torch import Tensor
from torch.nn import functional as f

from l3ps.errors import ModelError, Problem, first_line

from .base import Backbone, digest, input_spec

if TYPE_CHECKING:
    from timm.models.vision_transformer import VisionTransformer

PATCH = 14
OFFSET = 0.1
"""Of the published scale factor for models without registers; keeps the grid from losing a row to rounding."""
SERVER = "https://dl.fbaipublicfiles.com/dinov2"
PATIENCE = 20.0
"""Seconds without a byte after which a download counts as failed."""


@dataclass(frozen=True)
class Variant:
    """One published network.

    Attributes:
        timm: its architecture's name in timm.
        hub: its name in Meta's files.
        registers: whether it has four register tokens.
    """

    timm: str
    hub: str
    registers: bool

    @property
    def url(self) -> str:
        """Where its official weights are."""
        return f"{SERVER}/{self.hub}/{self.hub}_{'reg4_' if self.registers else ''}pretrain.pth"


_NAMES = {"s": ("small", "s"), "b": ("base", "b"), "l": ("large", "l"), "g": ("giant", "g")}
VARIANTS = {
    f"dinov2-{letter}{'-reg' if registers else ''}": Variant(
        f"vit_{timm_name}_patch14_{'reg4_' if registers else ''}dinov2", f"dinov2_vit{hub}14", registers
    )
    for registers in (False, True)
    for letter, (timm_name, hub) in _NAMES.items()
}


class DinoV2(Backbone):
    """Last-layer patch tokens of a frozen DINOv2 as a feature map at 1/14 of the input.

    Args:
        name: key of :data:`VARIANTS`.
        weights: state dict in DINOv2's own naming, or None for random weights, which only measurements of speed use.
        size: (height, width) of the input, multiples of 14.
        architecture: what differs from the published network, for tests (``depth=2``).

    Raises:
        ModelError: the weights are not those of this network, or the size is no multiple of 14.
    """

    stride = PATCH

    def __init__(
        self, name: str, weights: Mapping[str, Tensor] | None, size: tuple[int, int], **architecture: Any
    ) -> None:
        super().__init__()
        self.check(size)
        self.name, self.spec = name, input_spec(size)
        self._weights, self._architecture = weights, architecture
        self.variant = VARIANTS[name]
        self.vit = _network(self.variant, weights, size, architecture)
        self.channels = int(self.vit.embed_dim)
        self.identity = digest(weights) if weights is not None else "untrained"
        self.requires_grad_(False).eval()

    def forward(self, images: Tensor) -> Tensor:
        tokens = self.vit.forward_features(images)[:, self.vit.num_prefix_tokens :]
        rows, columns = self.spec.height // PATCH, self.spec.width // PATCH
        return tokens.transpose(1, 2).reshape(len(images), self.channels, rows, columns)

    def check(self, size: tuple[int, int], option: str = "--size") -> None:
        """Refuse what is no multiple of 14."""
        if size[0] % PATCH or size[1] % PATCH:
            near = "x".join(str(max(1, round(s / PATCH)) * PATCH) for s in size)
            what = f"DINOv2 sees patches of {PATCH} pixels, and {size[0]}x{size[1]} is no multiple of it"
            raise ModelError(Problem("bad-size", option, what, f"Take {near}."))

    def at(self, size: tuple[int, int]) -> DinoV2:
        """The same weights for another input, the position embedding resized from the original."""
        return DinoV2(self.name, self._weights, size, **self._architecture)


@contextmanager
def runtime_attention(backbone: DinoV2) -> Iterator[None]:
    """Within the block, attention is one operator that ONNX Runtime brings along, for export only.

    Written out, a ViT-S/14 at 448×798 stores 80 MB of attention weights in each of its twelve blocks; the runtime's
    ``com.microsoft.MultiHeadAttention`` never does. That saves a tenth of the time in float32 and a fifth in int8.
    """
    modules = [cast(Any, block).attn for block in backbone.vit.blocks]
    for module in modules:
        module.forward = partial(_attention, module)
    try:
        yield
    finally:
        for module in modules:
            del module.forward


def _attention(module: Any, tokens: Tensor, **_: Any) -> Tensor:
    queries, keys, values = module.qkv(tokens).chunk(3, dim=-1)
    attended = torch.onnx.ops.symbolic(
        "com.microsoft::MultiHeadAttention",
        (queries, keys, values),
        {"num_heads": module.num_heads, "scale": float(module.scale)},
        dtype=tokens.dtype,
        shape=tokens.shape,
        version=1,
    )
    out: Tensor = module.proj(attended)
    return out


def fetch(name: str, file: Path | None) -> dict[str, Tensor]:
    """Official weights: from a file, else from Meta's server (kept in torch's hub folder).

    Args:
        name: key of :data:`VARIANTS`.
        file: a ``.pth`` in DINOv2's own naming, or None to download it.

    Raises:
        ModelError: there is no such file, it is not a state dict, or the server cannot be reached.
    """
    url = VARIANTS[name].url
    if file is not None:
        return read_state(file)
    try:
        with _impatient():
            state = torch.hub.load_state_dict_from_url(url, map_location="cpu", progress=False, weights_only=True)
    except (URLError, OSError, pickle.UnpicklingError, RuntimeError) as error:
        what = f"no weights were given and they cannot be downloaded ({getattr(error, 'reason', error)})"
        raise ModelError(
            Problem("no-weights", name, what, f"Download {url} where there is a network and name it with --weights.")
        ) from error
    return cast(dict[str, Tensor], state)


def read_state(file: Path) -> dict[str, Tensor]:
    """Read a state dict without running any code that the pickle may hold.

    Raises:
        ModelError: the file is missing or holds no plain state dict.
    """
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise _wrong(file, "there is no such file") from error
    except Exception as error:  # what the bytes of any file make of an unpickler
        raise _wrong(file, f"it cannot be read as a torch state dict ({first_line(error)})") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise _wrong(file, "it holds no plain state dict of tensors")
    return state


def resized_positions(grid: Tensor, size: tuple[int, int], *, registers: bool) -> Tensor:
    """Position embedding for another grid of patches, as the published code computes it.

    Args:
        grid: (1, M², D) embedding of the patches of the square training image.
        size: (rows, columns) of patches.
        registers: whether the network has register tokens; see the module.

    Returns:
        (1, rows * columns, D).
    """
    side = round(grid.shape[1] ** 0.5)
    if size == (side, side):
        return grid
    planes = grid.float().reshape(1, side, side, -1).permute(0, 3, 1, 2)
    if registers:
        planes = f.interpolate(planes, size=size, mode="bicubic", antialias=True)
    else:
        factor = [(n + OFFSET) / side for n in size]
        planes = f.interpolate(planes, scale_factor=factor, mode="bicubic", recompute_scale_factor=False)
    return planes.permute(0, 2, 3, 1).reshape(1, size[0] * size[1], -1)


def _network(
    variant: Variant, weights: Mapping[str, Tensor] | None, size: tuple[int, int], architecture: dict[str, Any]
) -> VisionTransformer:
    import timm  # noqa: PLC0415  (it takes seconds to import, which other backbones need not wait for)
    from timm.models.vision_transformer import checkpoint_filter_fn  # noqa: PLC0415

    vit = cast(
        "VisionTransformer",
        timm.create_model(variant.timm, pretrained=False, num_classes=0, img_size=size, **architecture),
    )
    if weights is None:
        return vit
    state = dict(weights)
    state.setdefault("mask_token", torch.zeros(0))  # by it timm knows DINOv2's naming
    positions = state.get("pos_embed")
    if (
        positions is None
        or positions.ndim != 3
        or round((positions.shape[1] - 1) ** 0.5) ** 2 != positions.shape[1] - 1
    ):
        raise _misfit(variant, "they have no position embedding of a square image")
    rows_columns = (size[0] // PATCH, size[1] // PATCH)
    patches = resized_positions(positions[:, 1:], rows_columns, registers=variant.registers)
    state["pos_embed"] = torch.cat([positions[:, :1], patches], dim=1)
    if variant.registers != ("register_tokens" in state):
        having = "have" if "register_tokens" in state else "lack"
        raise _misfit(variant, f"they {having} register tokens")
    try:
        vit.load_state_dict(checkpoint_filter_fn(state, vit), strict=True)
    except (RuntimeError, KeyError) as error:
        told = " ".join(str(error).split())
        raise _misfit(variant, f"names or shapes differ ({told[:200]} …)") from error
    return vit


@contextmanager
def _impatient() -> Iterator[None]:
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(PATIENCE)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


def _misfit(variant: Variant, what: str) -> ModelError:
    remedy = f"Take the official file: {variant.url}."
    return ModelError(Problem("wrong-weights", variant.hub, f"the weights are not this network's: {what}", remedy))


def _wrong(file: Path, what: str) -> ModelError:
    return ModelError(Problem("bad-weights", str(file), what, "Name an official .pth file of DINOv2."))
