# SPDX-License-Identifier: Apache-2.0
"""How the light of a scene is sampled: samples, path lengths, photons, seed."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, TypedDict

from rangesim.light_transport.sampler import Sampler
from rangesim.settings.bounds import Bounds, check_fields, whole
from rangesim.settings.config import check_keys, shown
from rangesim.settings.seeds import check_seed

Indirect = Literal["filtered", "raw"]
PHOTONS = 500_000


@dataclass(frozen=True)
class TransportSettings:
    """Settings of `rangesim.transport`, which takes each of them by name as well.

    Parameters
    ----------
    spp : int >= 1, samples (camera paths) per pixel. Or AdaptiveSampling: 8, and then up to 64, as many as it takes
        until the renderer's noise in the readings of its instruments is small against that of their detectors. "auto":
        this, for the sensors with their default detectors; for bare responses, and without `sampling_error`, 16 where
        pixels share their indirect light and 64 elsewhere.
    max_depth : int >= 1, segments of a path between surfaces that scatter it, up to the light: 2 is direct light alone,
        as in Mitsuba. Delta interactions (glass, mirrors, thin panes, coats, holes) do not count; they have a limit of
        their own, `rangesim.light_transport.specular_chain.MAX_CHAIN` in a row.
    rr_depth : int >= 1, surfaces that scatter after which Russian roulette may end a path.
    seed : int, 0 to 2^64 - 1; the same seed gives the same bytes, whatever the number of threads and the memory
        budget, and each its own noise.
    photons : int >= 0, caustic photons: the projector's light through glass and off mirrors, see
        `rangesim.light_transport.photons`; 0: none, and such light is missing. No cost without such surfaces.
    caustic_radius_m : metres, largest radius over which photons are gathered; None: as wide as the number of photons
        asks for, at most three pixels of the projector or of the camera at the distance of the point. Caustics are
        blurred by about half of it.
    glint : whether the camera sees the projector's lens, in a mirror, through glass or directly.
    indirect : "filtered": neighbouring pixels of a matte surface share their multipath, with a small bias and far less
        noise (`rangesim.light_transport.indirect_filter`); "raw": the unbiased sum over each pixel's own paths.
    sampling_error : whether `StillSignals.sampling` is estimated, which takes as much memory again as the signals and
        some time; adaptive sampling needs it.
    memory_bytes : the image is rendered in tiles that keep the renderer's arrays below this size; photons that landed
        come on top, some 200 bytes each.

    Raises
    ------
    ValueError
        A setting is out of its range, or adaptive sampling has no sampling error to go by.
    """

    spp: Annotated[int, whole(1, "spp")] | Literal["auto"] | Sampler = "auto"
    max_depth: Annotated[int, whole(1, "depth")] = 5
    rr_depth: Annotated[int, whole(1, "depth")] = 5
    seed: int = 0
    photons: Annotated[int, whole(0, "photons")] = PHOTONS
    caustic_radius_m: Annotated[float, Bounds("metres of at least 1e-06", 1e-6)] | None = None
    glint: bool = True
    indirect: Indirect = "filtered"
    sampling_error: bool = True
    memory_bytes: Annotated[int, whole(1)] = 2 << 30

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed(self.seed))
        check_fields(self)
        if isinstance(self.spp, Sampler) and not self.sampling_error:
            raise ValueError(f"expected sampling_error=True with {type(self.spp).__name__}, which goes by it.")


class TransportOptions(TypedDict, total=False):
    """The fields of `TransportSettings` by name, for editors and type checkers."""

    spp: int | Literal["auto"] | Sampler
    max_depth: int
    rr_depth: int
    seed: int
    photons: int
    caustic_radius_m: float | None
    glint: bool
    indirect: Indirect
    sampling_error: bool
    memory_bytes: int


def chosen(settings: TransportSettings | None, options: TransportOptions) -> TransportSettings:
    """The settings, or the defaults, with some changed; ValueError names one that is not there or out of its range."""
    check_keys(options, [f.name for f in fields(TransportSettings)], "options")
    if settings is None:
        settings = TransportSettings()
    if not isinstance(settings, TransportSettings):
        raise ValueError(f"expected settings as TransportSettings, got {shown(settings)}.")
    return replace(settings, **options)
