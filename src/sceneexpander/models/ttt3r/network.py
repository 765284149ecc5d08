"""The recurrent network: encode a view, read and update the state, predict (ttt3r spec 4, 5, 7).

Nothing of the past is kept but the state and the pose memory, whose sizes do not depend on the number of views.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.block import Block
from sceneexpander.models.layers.rope import RopeTable, grid_rope
from sceneexpander.models.layers.vit import PatchConv
from sceneexpander.models.ttt3r.blocks import NORM_EPS, DecoderBlock
from sceneexpander.models.ttt3r.config import TTT3RConfig
from sceneexpander.models.ttt3r.heads import ALL_MAPS, DenseMap, StepHeads, StepMaps

RAY_CHANNELS = 6
POSE_POSITION = -1  # row and column of the pose token; patches count from 0


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamStep:
    """One time step of B scenes in step. A step without an image queries a camera and never updates the state."""

    image: Float[Tensor, "batch 3 height width"] | None = None  # in [-1, 1]
    rays: Float[Tensor, "batch height width 6"] | None = None  # see `sceneexpander.models.ttt3r.images.ray_map`
    update: bool = True
    reset: bool = False  # forget the state after this step, its own update included

    def __post_init__(self) -> None:
        if len(set(self._sizes())) != 1:
            raise ValueError(f"a time step needs an image, a ray map or both of one size, got sizes {self._sizes()}")

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self._sizes()[0]

    def _sizes(self) -> list[tuple[int, int]]:
        sizes = []
        if self.image is not None:
            sizes.append((self.image.shape[-2], self.image.shape[-1]))
        if self.rays is not None:
            sizes.append((self.rays.shape[-3], self.rays.shape[-2]))
        return sizes


@dataclass(frozen=True, slots=True, kw_only=True)
class RecurrentState:
    """All that a stream remembers."""

    tokens: Float[Tensor, "batch slot dim"]
    memory: Float[Tensor, "batch memory double_dim"]
    fresh: bool  # no step has been taken since the start or the last reset


@dataclass(frozen=True, slots=True, kw_only=True)
class Decoded:
    """What the decoders make of one step."""

    levels: tuple[Tensor, ...]  # inputs of the dense heads
    pose_query: Float[Tensor, "batch 1 dim"]
    pose_token: Float[Tensor, "batch 1 dim"]
    state_tokens: Float[Tensor, "batch slot dim"]  # candidate for the next state
    memory: Float[Tensor, "batch memory double_dim"]  # candidate for the next memory
    rate: Float[Tensor, "batch slot"]  # learning rate of each state token, in (0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepOutput:
    """One time step: predictions, and the state before and after it."""

    maps: StepMaps
    features: Float[Tensor, "batch patch encoder_dim"]
    decoded: Decoded
    before: RecurrentState
    after: RecurrentState


class PoseMemory(nn.Module):
    """Associates what a view looks like with its pose token."""

    def __init__(self, config: TTT3RConfig) -> None:
        super().__init__()
        width = 2 * config.dim
        self.dim = config.dim
        self.mem = nn.Parameter(torch.zeros(1, config.memory_slots, width))
        self.masked_token = nn.Parameter(torch.zeros(1, 1, config.dim))
        self.proj_q = nn.Linear(config.encoder_dim, config.dim)

        def blocks() -> nn.ModuleList:
            depth, heads = config.memory_depth, config.heads
            return nn.ModuleList([DecoderBlock(width, heads, mlp_ratio=config.mlp_ratio) for _ in range(depth)])

        self.write_blocks = blocks()
        self.read_blocks = blocks()

    def read(
        self, pooled: Float[Tensor, "batch 1 encoder_dim"], memory: Float[Tensor, "batch memory double_dim"]
    ) -> Float[Tensor, "batch 1 dim"]:
        """The pose token that the memory associates with a view."""
        query = torch.cat([self.proj_q(pooled), self.masked_token.expand(pooled.shape[0], -1, -1)], dim=-1)
        for block in self.read_blocks:
            query, _ = block(query, memory)
        return query[..., self.dim :]

    def write(
        self,
        pooled: Float[Tensor, "batch 1 encoder_dim"],
        pose_token: Float[Tensor, "batch 1 dim"],
        memory: Float[Tensor, "batch memory double_dim"],
    ) -> Float[Tensor, "batch memory double_dim"]:
        """The memory with this association added."""
        entry = torch.cat([self.proj_q(pooled), pose_token], dim=-1)
        for block in self.write_blocks:
            memory, _ = block(memory, entry)
        return memory


class RecurrentNetwork(nn.Module):
    """CUT3R; parameter names are those of the public checkpoint."""

    def __init__(self, config: TTT3RConfig) -> None:
        super().__init__()
        self.config = config
        encoder, dim, ratio = config.encoder_dim, config.dim, config.mlp_ratio
        self.pose_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.masked_img_token = nn.Parameter(torch.zeros(1, encoder))
        self.masked_ray_map_token = nn.Parameter(torch.zeros(1, encoder))
        self.patch_embed = PatchConv(config.patch, encoder)
        self.patch_embed_ray_map = PatchConv(config.patch, encoder, RAY_CHANNELS)

        def blocks(depth: int, heads: int, *, half_rope: bool) -> nn.ModuleList:
            return nn.ModuleList(
                [
                    Block(encoder, heads, mlp_ratio=ratio, norm_eps=NORM_EPS, layer_scale=None, half_rope=half_rope)
                    for _ in range(depth)
                ]
            )

        def decoder(heads: int) -> nn.ModuleList:
            return nn.ModuleList([DecoderBlock(dim, heads, mlp_ratio=ratio) for _ in range(config.depth)])

        self.enc_blocks = blocks(config.encoder_depth, config.encoder_heads, half_rope=config.encoder_rope_fp16)
        self.enc_norm = nn.LayerNorm(encoder, eps=NORM_EPS)
        self.enc_blocks_ray_map = blocks(config.ray_depth, config.ray_heads, half_rope=False)
        self.enc_norm_ray_map = nn.LayerNorm(encoder, eps=NORM_EPS)
        self.register_tokens = nn.Embedding(config.state_tokens, encoder)
        self.decoder_embed = nn.Linear(encoder, dim)
        self.decoder_embed_state = nn.Linear(encoder, dim)
        self.dec_blocks = decoder(config.heads)
        self.dec_norm = nn.LayerNorm(dim, eps=NORM_EPS)
        self.dec_blocks_state = decoder(config.state_heads)
        self.dec_norm_state = nn.LayerNorm(dim, eps=NORM_EPS)
        self.pose_retriever = PoseMemory(config)
        self.downstream_head = StepHeads(config)

    def stream(
        self, steps: Iterable[StreamStep], *, maps: frozenset[DenseMap] = ALL_MAPS, fill_absent: bool = False
    ) -> Iterator[StepOutput]:
        """Run the recurrence, one output per step, consuming and producing lazily.

        Args:
            steps: views in order; sizes may differ between steps, the batch size not.
            maps: dense maps to compute.
            fill_absent: see `fuse`.

        Raises:
            ValueError: for a size that is not a multiple of the patch side.
        """
        state: RecurrentState | None = None
        for step in steps:
            features, grid = self.fuse(step, fill_absent=fill_absent)
            before = self.initial_state(features.shape[0]) if state is None else state
            decoded = self.decode(features, grid, before)
            if step.reset:
                after = self.initial_state(features.shape[0])
            else:
                after = self.updated(before, decoded, update=step.update and step.image is not None)
            patches = self._image_rope(grid, specials=0, heads=self.config.heads)
            predicted = self.downstream_head(decoded.levels, decoded.pose_token, patches, grid=grid, maps=maps)
            yield StepOutput(maps=predicted, features=features, decoded=decoded, before=before, after=after)
            state = after

    def initial_state(self, batch: int) -> RecurrentState:
        """The learned state before any view."""
        tokens = self.decoder_embed_state(self.register_tokens.weight)
        return RecurrentState(
            tokens=tokens.expand(batch, -1, -1), memory=self.pose_retriever.mem.expand(batch, -1, -1), fresh=True
        )

    def encode_image(self, image: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch patch encoder_dim"]:
        """Patch tokens of images in [-1, 1]."""
        rope = self._encoder_rope(image.shape[-2:], self.config.encoder_heads)
        tokens = self.patch_embed(image)
        for block in self.enc_blocks:
            tokens = block(tokens, rope)
        return self.enc_norm(tokens)

    def encode_rays(self, rays: Float[Tensor, "batch height width 6"]) -> Float[Tensor, "batch patch encoder_dim"]:
        """Patch tokens of ray maps."""
        rope = self._encoder_rope(rays.shape[1:3], self.config.ray_heads)
        tokens = self.patch_embed_ray_map(rays.movedim(-1, 1))
        for block in self.enc_blocks_ray_map:
            tokens = block(tokens, rope)
        return self.enc_norm_ray_map(tokens)

    def fuse(
        self, step: StreamStep, *, fill_absent: bool = False
    ) -> tuple[Float[Tensor, "batch patch encoder_dim"], tuple[int, int]]:
        """(tokens of what the step shows, rows and columns of patches): the sum over image and ray map.

        ``fill_absent`` adds the learned token of whichever is absent, as the released multi-view evaluation does for all views
        as soon as one of them has a ray map; streaming inference does not.
        """
        height, width = step.size
        patch = self.config.patch
        if height % patch or width % patch or not height * width:
            raise ValueError(f"image size {height} x {width} is not a multiple of {patch}")
        parts: list[Tensor] = []
        if step.image is not None:
            parts.append(self.encode_image(step.image))
        elif fill_absent:
            parts.append(self.masked_img_token)
        if step.rays is not None:
            parts.append(self.encode_rays(step.rays))
        elif fill_absent:
            parts.append(self.masked_ray_map_token)
        features = parts[0] if len(parts) == 1 else parts[0] + parts[1]
        return features, (height // patch, width // patch)

    def decode(
        self, features: Float[Tensor, "batch patch encoder_dim"], grid: tuple[int, int], state: RecurrentState
    ) -> Decoded:
        """Both decoders, layer by layer: each reads what the other was one layer before."""
        config = self.config
        pooled = features.mean(1, keepdim=True)
        if state.fresh:
            pose_query = self.pose_token.expand(features.shape[0], -1, -1)
        else:
            pose_query = self.pose_retriever.read(pooled, state.memory)
        view = torch.cat([pose_query, self.decoder_embed(features)], dim=1)
        slots = state.tokens
        # Head widths differ between the decoders, hence a table of each stream for each decoder.
        view_in_view, slots_in_view = self._ropes(grid, config.heads)
        view_in_slots, slots_in_slots = self._ropes(grid, config.state_heads)
        levels, alignments = [features], []
        for number, (view_block, slot_block) in enumerate(zip(self.dec_blocks, self.dec_blocks_state, strict=True), 1):
            new_slots, alignment = slot_block(slots, view, slots_in_slots, view_in_slots)
            view, _ = view_block(view, slots, view_in_view, slots_in_view)
            slots = new_slots
            alignments.append(alignment)
            levels += [view[:, 1:]] * config.dense_layers.count(number)
        view = self.dec_norm(view)
        pose_token = view[:, :1]
        return Decoded(
            levels=(*levels, view[:, 1:]),
            pose_query=pose_query,
            pose_token=pose_token,
            state_tokens=self.dec_norm_state(slots),
            memory=self.pose_retriever.write(pooled, pose_token, state.memory),
            rate=torch.sigmoid(torch.stack(alignments).mean(0)),
        )

    def updated(self, state: RecurrentState, decoded: Decoded, *, update: bool) -> RecurrentState:
        """The state after a step: by the rate of each token, in full for the first step and under the plain CUT3R rule."""
        if not update:
            return replace(state, fresh=False)
        tokens = decoded.state_tokens
        if self.config.update == "ttt3r" and not state.fresh:
            rate = decoded.rate[..., None]
            tokens = rate * tokens + (1 - rate) * state.tokens
        return RecurrentState(tokens=tokens, memory=decoded.memory, fresh=False)

    def _image_rope(self, grid: tuple[int, int], *, specials: int, heads: int) -> RopeTable:
        return self._rope(*grid, specials=specials, head_dim=self.config.dim // heads)

    def _ropes(self, grid: tuple[int, int], heads: int) -> tuple[RopeTable, RopeTable]:
        """Rotations of (pose token and patches, state tokens) for a decoder of that many heads."""
        config = self.config
        slots = self._rope(*config.state_grid, specials=0, head_dim=config.dim // heads)
        return self._image_rope(grid, specials=1, heads=heads), slots.first(config.state_tokens)

    def _encoder_rope(self, size: Iterable[int], heads: int) -> RopeTable:
        rows, columns = (side // self.config.patch for side in size)
        return self._rope(rows, columns, specials=0, head_dim=self.config.encoder_dim // heads)

    def _rope(self, rows: int, columns: int, *, specials: int, head_dim: int) -> RopeTable:
        return grid_rope(
            rows,
            columns,
            specials=specials,
            origin=POSE_POSITION,
            head_dim=head_dim,
            base=self.config.rope_base,
            like=self.pose_token,
        )
