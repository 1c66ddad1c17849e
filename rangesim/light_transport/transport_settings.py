# SPDX-License-Identifier: Apache-2.0
"""The settings of a light-transport pass: number of samples, length of paths, photons, seed, memory."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, TypedDict

from rangesim.light_transport.samples_per_pixel import Sampler
from rangesim.settings.bounds import Bounds, check_fields, whole
from rangesim.settings.config import check_keys, shown
from rangesim.settings.seeds import check_seed

Indirect = Literal["filtered", "raw"]
"""How indirect light is estimated, see `TransportSettings.indirect`."""
PHOTONS_PER_PIXEL = 8
"""Default number of caustic photons per pixel of the camera, within `FEWEST_PHOTONS` and `MOST_PHOTONS`. A coarse pixel
gathers the photons of the whole surface that it covers. With 8, a pixel of a camera of 160 x 120 gathers as many as
one of 640 x 480 gathers of `MOST_PHOTONS`: about 500 (docs/caustics.md)."""
FEWEST_PHOTONS, MOST_PHOTONS = 100_000, 500_000
"""Smallest and largest default number of caustic photons. On `tabletop`, 320 x 240 pixels, 50 000 photons take the same
time as 500 000 and make caustics twice as noisy; 5 000 000 take nearly four times as long (docs/caustics.md)."""


@dataclass(frozen=True)
class TransportSettings:
    """Settings of `rangesim.transport`, which also takes each of them by name.

    Parameters
    ----------
    spp : int >= 1, number of samples (camera paths) per pixel; or a Sampler such as AdaptiveSampling, which takes 8
        samples and then up to 64, until the renderer's noise in the readings of its instruments is small compared with
        the noise of their detectors. "auto" is AdaptiveSampling for the sensors of the pass with their default
        detectors. For bare responses, and without `sampling_error`, "auto" is 16 samples where pixels share their
        indirect light, and 64 elsewhere.
    max_depth : int >= 1, largest number of segments of a path between surfaces that scatter it, including the last
        segment to the light. 2 means direct light only, as in Mitsuba. Delta interactions (glass, mirrors, thin panes,
        coats, holes) do not count. They have a limit of their own, `rangesim.light_transport.specular_chain.MAX_CHAIN`
        in a row.
    rr_depth : int >= 1, number of surfaces that scatter after which Russian roulette may end a path.
    seed : int, 0 to 2^64 - 1. The same seed gives the same bytes for any number of threads and any memory budget.
    photons : int >= 0, number of caustic photons, which bring the projector's light through glass and off mirrors, see
        `rangesim.light_transport.photons`. With 0 this light is missing. They cost nothing in a scene without glass and
        mirrors. None: 8 per pixel of the camera, but at least 100 000 and at most 500 000.
    caustic_radius_m : metres, largest radius over which photons are gathered. None: the radius follows from the number
        of photons, and is at most three pixels of the projector or of the camera at the distance of the point.
        Caustics are blurred by about half of the radius.
    glint : whether the camera sees the projector's lens, in a mirror, through glass or directly.
    indirect : "filtered": neighbouring pixels of a matte surface share their multipath, with a small bias and much less
        noise (`rangesim.light_transport.indirect_filter`). "raw": the unbiased sum over each pixel's own paths.
    sampling_error : whether `StillSignals.sampling` is estimated. This takes some time, and as much memory as the
        signals themselves. A Sampler needs it.
    memory_bytes : bytes. The image is rendered in tiles so that the renderer's arrays stay below this size. Photons
        that landed take another 200 bytes each.

    Raises
    ------
    ValueError
        A setting is out of its range, or spp is a Sampler and `sampling_error` is False.

    Examples
    --------
    >>> settings = TransportSettings(spp=64, max_depth=8, seed=1)
    >>> settings.photons_for(160 * 120), settings.photons_for(640 * 480)
    (153600, 500000)
    >>> TransportSettings(spp=0)
    Traceback (most recent call last):
    ValueError: expected spp to be a whole number of at least 1, got 0.
    """

    spp: Annotated[int, whole(1, "spp")] | Literal["auto"] | Sampler = "auto"
    max_depth: Annotated[int, whole(1, "depth")] = 5
    rr_depth: Annotated[int, whole(1, "depth")] = 5
    seed: int = 0
    photons: Annotated[int, whole(0, "photons")] | None = None
    caustic_radius_m: Annotated[float, Bounds("metres of at least 1e-06", 1e-6)] | None = None
    glint: bool = True
    indirect: Indirect = "filtered"
    sampling_error: bool = True
    memory_bytes: Annotated[int, whole(1)] = 2 << 30

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed(self.seed))
        check_fields(self)
        if isinstance(self.spp, Sampler) and not self.sampling_error:
            raise ValueError(f"expected sampling_error=True with {type(self.spp).__name__}, which needs it.")

    def photons_for(self, pixels: int) -> int:
        """Number of caustic photons for a camera of so many pixels."""
        if self.photons is not None:
            return self.photons
        return min(max(PHOTONS_PER_PIXEL * pixels, FEWEST_PHOTONS), MOST_PHOTONS)


class TransportOptions(TypedDict, total=False):
    """The fields of `TransportSettings` by name, for editors and type checkers."""

    spp: int | Literal["auto"] | Sampler
    max_depth: int
    rr_depth: int
    seed: int
    photons: int | None
    caustic_radius_m: float | None
    glint: bool
    indirect: Indirect
    sampling_error: bool
    memory_bytes: int


def with_options(settings: TransportSettings | None, options: TransportOptions) -> TransportSettings:
    """The settings with some of their fields replaced.

    Parameters
    ----------
    settings : None: the defaults.
    options : new values by the names of the fields.

    Raises
    ------
    ValueError
        An option is no field, or is out of its range. The message names it.

    Examples
    --------
    >>> with_options(None, {"spp": 16}).spp
    16
    """
    check_keys(options, [f.name for f in fields(TransportSettings)], "options")
    if settings is None:
        settings = TransportSettings()
    if not isinstance(settings, TransportSettings):
        raise ValueError(f"expected settings as TransportSettings, got {shown(settings)}.")
    return replace(settings, **options)
