# SPDX-License-Identifier: Apache-2.0
"""The settings of a light-transport pass: number of samples, length of paths, kinds of light, seed, memory."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, TypedDict

from rangesim.light_transport.samples_per_pixel import Sampler
from rangesim.settings.bounds import check_fields, whole
from rangesim.settings.config import check_keys, shown
from rangesim.settings.seeds import check_seed

Indirect = Literal["filtered", "raw"]
"""How indirect light is estimated, see `TransportSettings.indirect`."""


@dataclass(frozen=True)
class TransportSettings:
    """Settings of `rangesim.transport`, which also takes each of them by name.

    Parameters
    ----------
    spp : int >= 1, number of samples (camera paths) per pixel; or a Sampler such as AdaptiveSampling, which takes 8
        samples and then up to 64, until the renderer's noise in the readings of its instruments is small compared with
        the noise of their detectors. "auto" is AdaptiveSampling for the sensors of the pass with their default
        detectors. For bare responses, and without `sampling_error`, "auto" is 16 samples where pixels share their
        indirect light, and 64 elsewhere. With `sampling_error`, pixels with uneven caustics get more, up to 256.
    max_depth : int >= 1, largest number of segments of a path between surfaces that scatter it, including the last
        segment to the light. 2 means direct light only, as in Mitsuba. Delta interactions (glass, mirrors, thin panes,
        coats, holes) do not count. They have a limit of their own, `rangesim.light_transport.specular_chain.MAX_CHAIN`
        in a row.
    rr_depth : int >= 1, number of surfaces that scatter after which Russian roulette may end a path.
    seed : int, 0 to 2^64 - 1. The same seed gives the same bytes for any number of threads and any memory budget.
    caustics : whether the light of the projector, and of lamps without extent, reaches surfaces through glass and off
        mirrors (`rangesim.light_transport.caustic_sheets`, `rangesim.light_transport.lamps`), and that of the projector
        off polished metal. It costs nothing in a scene without these.
    glint : whether the camera sees the projector's lens, in a mirror, through glass or directly.
    indirect : "filtered": neighbouring pixels of a matte surface share their multipath, with a small bias and much less
        noise (`rangesim.light_transport.indirect_filter`). "raw": the unbiased sum over each pixel's own paths.
    sampling_error : whether `StillSignals.sampling` is estimated. This takes some time, and as much memory as the
        signals themselves. A Sampler needs it.
    memory_bytes : bytes. The image is rendered in tiles so that the renderer's arrays stay below this size. The
        triangles of caustics come on top.

    Raises
    ------
    ValueError
        A setting is out of its range, or spp is a Sampler and `sampling_error` is False.

    Examples
    --------
    >>> settings = TransportSettings(spp=64, max_depth=8, seed=1)
    >>> settings.caustics, settings.glint
    (True, True)
    >>> TransportSettings(spp=0)
    Traceback (most recent call last):
    ValueError: expected spp to be a whole number of at least 1, got 0.
    """

    spp: Annotated[int, whole(1, "spp")] | Literal["auto"] | Sampler = "auto"
    max_depth: Annotated[int, whole(1, "depth")] = 5
    rr_depth: Annotated[int, whole(1, "depth")] = 5
    seed: int = 0
    caustics: bool = True
    glint: bool = True
    indirect: Indirect = "filtered"
    sampling_error: bool = True
    memory_bytes: Annotated[int, whole(1)] = 2 << 30

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed(self.seed))
        check_fields(self)
        if isinstance(self.spp, Sampler) and not self.sampling_error:
            raise ValueError(f"expected sampling_error=True with {type(self.spp).__name__}, which needs it.")


class TransportOptions(TypedDict, total=False):
    """The fields of `TransportSettings` by name, for editors and type checkers."""

    spp: int | Literal["auto"] | Sampler
    max_depth: int
    rr_depth: int
    seed: int
    caustics: bool
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
