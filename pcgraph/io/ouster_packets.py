# SPDX-License-Identifier: Apache-2.0
"""Packets of Ouster LiDARs, the sensor's metadata (JSON) with their layout, and the turns that they form.

Source of the packets and their profiles: Ouster, "Firmware User Manual", section "Lidar data" (lidar data packet
format), and "Software User Manual" for the legacy format.

Words have 32 bits and are little-endian. A packet holds columns. A column holds its time, its number within the turn
(measurement), a status, and a block of words for each ring. The profile says which bits of a block are the range, the
reflectivity and the other numbers.
"""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Annotated, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from pcgraph.errors import CloudReadError
from pcgraph.io.pcap import Datagram, datagrams
from pcgraph.plumbing.short_repr import ShortRepr, in_short

MAX_COLUMNS = 4_096
"""Largest count of columns in a turn, from the finest mode of any sensor."""
MAX_RINGS = 512
"""Largest count of rings: twice the 256 of the OS1 Max."""
MAX_PACKET = 65_507
"""Largest packet, bytes, because no more fit into a UDP datagram over IPv4 (RFC 768, RFC 791)."""
ROTATION_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I| of a rotation R in the metadata, dimensionless: five times the 2e-5 that come from
rounding to five decimals."""

# ---- Profiles: where the bits are -----------------------------------------------------------------------------------


class BitField(NamedTuple):
    """The place of a number in a block of words.

    word, first_bit, bits : the word, its first bit from the least significant one, and the number of bits.
    unit_bits : power of two of the unit: a range in steps of 8 mm has 3.
    """

    word: int
    first_bit: int
    bits: int
    unit_bits: int = 0

    def read(self, words: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """The numbers in blocks of words (..., words)."""
        mask = np.uint32((1 << self.bits) - 1)
        return ((words[..., self.word] >> np.uint32(self.first_bit)) & mask) << np.uint32(self.unit_bits)


class Profile(NamedTuple):
    """The layout of one ring's block in a column.

    words : words of the block. fields : the numbers in it by name; those of a second return end in 2.
    """

    words: int
    fields: dict[str, BitField]


_DUAL = {
    "range": BitField(0, 0, 19),
    "flags": BitField(0, 19, 5),
    "reflectivity": BitField(0, 24, 8),
    "range2": BitField(1, 0, 19),
    "flags2": BitField(1, 19, 5),
    "reflectivity2": BitField(1, 24, 8),
    "signal": BitField(2, 0, 16),
    "signal2": BitField(2, 16, 16),
    "near_ir": BitField(3, 0, 16),
}
_LOW_RATE = {
    "range": BitField(0, 0, 15, 3),
    "flags": BitField(0, 15, 1),
    "reflectivity": BitField(0, 16, 8),
    "near_ir": BitField(0, 24, 8, 4),
}
_LOW_RATE_DUAL = {
    **_LOW_RATE,
    "range2": BitField(1, 0, 15, 3),
    "flags2": BitField(1, 15, 1),
    "reflectivity2": BitField(1, 16, 8),
}
PROFILES = {
    "LEGACY": Profile(
        3,
        {
            "range": BitField(0, 0, 20),
            "flags": BitField(0, 28, 4),
            "reflectivity": BitField(1, 0, 16),
            "signal": BitField(1, 16, 16),
            "near_ir": BitField(2, 0, 16),
        },
    ),
    "RNG19_RFL8_SIG16_NIR16": Profile(
        3,
        {
            "range": BitField(0, 0, 19),
            "flags": BitField(0, 19, 5),
            "reflectivity": BitField(1, 0, 8),
            "signal": BitField(1, 16, 16),
            "near_ir": BitField(2, 0, 16),
        },
    ),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(4, _DUAL),
    "RNG15_RFL8_NIR8": Profile(1, _LOW_RATE),
    "RNG15_RFL8_NIR8_DUAL": Profile(2, _LOW_RATE_DUAL),
    "FUSA_RNG15_RFL8_NIR8_DUAL": Profile(2, _LOW_RATE_DUAL),
    "FIVE_WORD_PIXEL": Profile(5, _DUAL),
}
"""The profiles by name, as in the metadata (`udp_profile_lidar`); ranges are in millimetres."""


# ---- Metadata -------------------------------------------------------------------------------------------------------

Degrees = Annotated[float, msgspec.Meta(ge=-360, le=360)]
"""Angle of a beam in the metadata, degrees, from -360 to 360: a turn in either direction."""
Millimetres = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
"""Length in the metadata, or entry of a transform, millimetres. The limit of 100 m refuses damaged files only. Chosen
by eye; not varied."""


class _DataFormat(msgspec.Struct):
    """The part of the metadata that describes the layout of packets; other keys are ignored."""

    columns_per_frame: Annotated[int, msgspec.Meta(ge=1, le=MAX_COLUMNS)]
    columns_per_packet: Annotated[int, msgspec.Meta(ge=1, le=MAX_COLUMNS)]
    pixels_per_column: Annotated[int, msgspec.Meta(ge=1, le=MAX_RINGS)]
    pixel_shift_by_row: list[Annotated[int, msgspec.Meta(ge=-MAX_COLUMNS, le=MAX_COLUMNS)]]
    udp_profile_lidar: str = "LEGACY"


class _Metadata(msgspec.Struct):
    """The parts of the metadata that are used; other keys are ignored."""

    data_format: _DataFormat
    lidar_mode: str
    beam_altitude_angles: list[Degrees]
    beam_azimuth_angles: list[Degrees]
    lidar_to_sensor_transform: list[Millimetres]
    lidar_origin_to_beam_origin_mm: Millimetres = 0.0
    beam_to_lidar_transform: list[Millimetres] | None = None
    prod_sn: str | int = 0


_GROUPS = ("sensor_info", "beam_intrinsics", "lidar_intrinsics", "config_params")
"""Tables of the metadata of newer firmware; older ones have the same keys at the top."""


@dataclass(frozen=True, eq=False, repr=False)
class SensorMetadata(ShortRepr):
    """The layout of a sensor's packets and the geometry of its beams, from its metadata.

    Parameters
    ----------
    rings, columns, columns_per_packet : int, rings of a column, columns of a turn and of a packet.
    profile : name in `PROFILES`.
    period_s : float, seconds of a turn.
    elevations_rad, azimuths_rad : (rings,) float64, radians, of the beams against the head: up, and to the right.
    beam_origin_lidar_m : (3,) float64, metres, where the beams begin while the head points to azimuth 0, in Ouster's
        lidar frame: x against the connector, z up.
    pixel_shift : (rings,) int64, columns by which rows are shifted so that columns are directions.
    T_sensor_lidar : (4, 4) float64, metres, maps Ouster's lidar frame to its sensor frame.
    serial : int, serial number of the sensor; 0: not known.
    """

    rings: int
    columns: int
    columns_per_packet: int
    profile: str
    period_s: float
    elevations_rad: NDArray[np.float64]
    azimuths_rad: NDArray[np.float64]
    beam_origin_lidar_m: NDArray[np.float64]
    pixel_shift: NDArray[np.int64]
    T_sensor_lidar: NDArray[np.float64]
    serial: int = 0

    @property
    def beam_origin_distance_m(self) -> float:
        """Distance of the beams' origins from the axis of the head, metres; ranges in packets count from the axis."""
        return float(np.linalg.norm(self.beam_origin_lidar_m))


def read_metadata(content: bytes) -> SensorMetadata:
    """The metadata of a sensor, given the bytes of its JSON file; older and newer firmware.

    Raises
    ------
    CloudReadError
        The content is no JSON, or as for `metadata_of`.
    """
    try:
        data = msgspec.json.decode(content.removeprefix(codecs.BOM_UTF8))
    except (RecursionError, msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CloudReadError(f"expected metadata in JSON, got other text: {ascii(str(error))[1:-1][:160]}") from None
    return metadata_of(data)


def metadata_of(data: Any) -> SensorMetadata:
    """The metadata of a sensor from the plain data of its JSON file.

    Raises
    ------
    CloudReadError
        A key is missing, numbers are out of bounds or contradict each other, or the profile is not in `PROFILES`.
    """
    if not isinstance(data, dict):
        raise CloudReadError(f"expected metadata as a table, got {in_short(data)}")
    tables = [data[name] for name in _GROUPS if isinstance(data.get(name), dict)]
    merged = {key: value for table in (*tables, data) for key, value in table.items()}
    merged.setdefault("data_format", merged.get("lidar_data_format"))
    if merged["data_format"] is None:
        raise CloudReadError("expected metadata of an Ouster sensor with a data_format, found none")
    try:
        found = msgspec.convert(merged, _Metadata)
    except msgspec.ValidationError as error:
        what, _, place = str(error).partition(" - at `$.")
        raise CloudReadError(
            f"{what.replace('`', '').replace('Expected', 'expected')}{' in ' * bool(place)}{place.rstrip('`')}"
        ) from error
    return _checked_metadata(found)


def _checked_metadata(found: _Metadata) -> SensorMetadata:
    """The checked metadata; raises CloudReadError if values contradict each other."""
    layout, rings = found.data_format, found.data_format.pixels_per_column
    if layout.udp_profile_lidar not in PROFILES:
        raise CloudReadError(
            f"expected udp_profile_lidar to be one of {', '.join(PROFILES)}, got {in_short(layout.udp_profile_lidar)}"
        )
    columns, _, rate = found.lidar_mode.partition("x")
    if columns != str(layout.columns_per_frame) or not rate.isascii() or not rate.isdecimal() or not 0 < len(rate) < 4:
        raise CloudReadError(
            f"expected lidar_mode to be columns x turns per second, such as {layout.columns_per_frame}x10, got "
            f"{in_short(found.lidar_mode)}"
        )
    if int(rate) < 1:
        raise CloudReadError(f"expected turns per second of lidar_mode from 1, got {found.lidar_mode!r}")
    for name, values in (
        ("beam_altitude_angles", found.beam_altitude_angles),
        ("beam_azimuth_angles", found.beam_azimuth_angles),
        ("pixel_shift_by_row", layout.pixel_shift_by_row),
    ):
        if len(values) != rings:
            raise CloudReadError(f"expected {rings} numbers in {name}, one for each ring, got {len(values)}")
        if not np.isfinite(values).all():
            raise CloudReadError(f"expected finite numbers in {name}")
    if max(map(abs, found.beam_altitude_angles)) > 90:
        raise CloudReadError("expected beam_altitude_angles from -90 to 90 degrees")
    metadata = SensorMetadata(
        rings=rings,
        columns=layout.columns_per_frame,
        columns_per_packet=layout.columns_per_packet,
        profile=layout.udp_profile_lidar,
        period_s=1 / int(rate),
        elevations_rad=np.radians(found.beam_altitude_angles),
        azimuths_rad=np.radians(found.beam_azimuth_angles),
        beam_origin_lidar_m=_beam_origin(found),
        pixel_shift=np.array(layout.pixel_shift_by_row, dtype=np.int64),
        T_sensor_lidar=_transform("lidar_to_sensor_transform", found.lidar_to_sensor_transform),
        serial=_serial(found.prod_sn),
    )
    size = PacketLayout(metadata).size
    if size > MAX_PACKET:
        raise CloudReadError(f"expected packets of at most {MAX_PACKET} bytes, got {size} by the data_format")
    return metadata


def _beam_origin(found: _Metadata) -> NDArray[np.float64]:
    """Origin of the beams at azimuth 0, (3,) float64, metres, in the lidar frame."""
    if found.beam_to_lidar_transform is not None:
        return _transform("beam_to_lidar_transform", found.beam_to_lidar_transform)[:3, 3]
    if not np.isfinite(found.lidar_origin_to_beam_origin_mm):
        raise CloudReadError("expected lidar_origin_to_beam_origin_mm to be finite")
    return np.array([found.lidar_origin_to_beam_origin_mm / 1000, 0.0, 0.0])


def _transform(name: str, numbers: list[float]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) in metres from 16 numbers, row by row, in millimetres."""
    if len(numbers) != 16:
        raise CloudReadError(f"expected 16 numbers in {name}, got {len(numbers)}")
    matrix = np.array(numbers, dtype=np.float64).reshape(4, 4)
    matrix[:3, 3] /= 1000
    rotation = matrix[:3, :3]
    if not (
        np.isfinite(matrix).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
        and np.linalg.det(rotation) > 0
        and np.allclose(matrix[3], [0, 0, 0, 1])
    ):
        raise CloudReadError(f"expected {name} to be rigid (a rotation and a translation), got {matrix.tolist()}")
    matrix.setflags(write=False)
    return matrix


def _serial(value: str | int) -> int:
    """Serial number; 0 if the text has other characters than digits."""
    text = str(value) if isinstance(value, str) or abs(value) < 1 << 63 else ""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 19 else 0


# ---- Packets --------------------------------------------------------------------------------------------------------


class PacketLayout:
    """The layout of a sensor's packets: where their columns and words are.

    Attributes
    ----------
    size : int
        Bytes of a packet.
    """

    def __init__(self, metadata: SensorMetadata) -> None:
        self.metadata = metadata
        self.is_legacy = metadata.profile == "LEGACY"
        block = ("words", "<u4", (metadata.rings, PROFILES[metadata.profile].words))
        if self.is_legacy:
            kinds = [("time", "<u8"), ("column", "<u2"), ("frame", "<u2"), ("encoder", "<u4"), block, ("status", "<u4")]
        else:
            kinds = [("time", "<u8"), ("column", "<u2"), ("status", "<u2"), block]
        self.column = np.dtype(kinds)
        self.margin = 0 if self.is_legacy else 32  # bytes of the header, and as many of the footer
        self.size = 2 * self.margin + metadata.columns_per_packet * self.column.itemsize

    def columns(self, payload: bytes) -> np.ndarray:
        """(columns_per_packet,) structured array of a packet: time in ns, column, status, words (rings, words)."""
        return np.frombuffer(payload, self.column, self.metadata.columns_per_packet, self.margin)

    def is_lidar(self, payload: bytes) -> bool:
        """Whether a datagram may be a packet with ranges."""
        if len(payload) != self.size:
            return False
        return self.is_legacy or payload[0] == 1  # the type of the packet

    def frames(self, payload: bytes, columns: np.ndarray) -> NDArray[np.int64]:
        """(columns_per_packet,) numbers of the turns that the columns belong to."""
        if self.is_legacy:
            return columns["frame"].astype(np.int64)
        number = payload[4:8] if self._is_safety(payload) else payload[2:4]
        return np.full(len(columns), int.from_bytes(number, "little"), dtype=np.int64)

    def serial(self, payload: bytes) -> int:
        """Serial number of the sensor that sent a packet; 0: not known."""
        if self.is_legacy:
            return 0
        start = 11 if self._is_safety(payload) else 7
        return int.from_bytes(payload[start : start + 5], "little")

    def _is_safety(self, payload: bytes) -> bool:
        """Whether a packet has the header for functional safety, in which the numbers are at other places.

        Firmware uses either header with the same profile. If the serial number is known, its place in the packet tells
        which header it is.
        """
        if self.metadata.serial:
            return int.from_bytes(payload[11:16], "little") == self.metadata.serial
        return self.metadata.profile.startswith("FUSA")


# ---- Turns ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class OusterTurn(ShortRepr):
    """One turn of a sensor in firing order: h rings, w columns, k returns for each ray.

    Parameters
    ----------
    frame : int, number of the turn as the sensor counts.
    start_ns : int, clock of the sensor at the first column, nanoseconds.
    time_s : (w,) float64, seconds, when each column was measured, after the first; NaN for a column that is missing.
    range_m : (k, h, w) float32, metres, distance from where the beam begins; NaN where there is no return.
    reflectivity : (k, h, w) uint16, reflectivity as the device scales it. None: not sent.
    signal : (k, h, w) uint16, photons of the return. None: not sent.
    near_ir : (h, w) uint16, photons of the surroundings. None: not sent.
    """

    frame: int
    start_ns: int
    time_s: NDArray[np.float64]
    range_m: NDArray[np.float32]
    reflectivity: NDArray[np.uint16] | None = None
    signal: NDArray[np.uint16] | None = None
    near_ir: NDArray[np.uint16] | None = None

    @property
    def columns_measured(self) -> int:
        """Number of columns that are not missing."""
        return int(np.isfinite(self.time_s).sum())


def ouster_turns(file: IO[bytes], metadata: SensorMetadata, port: int | None = None) -> Iterator[OusterTurn]:
    """Iterator over the turns in an open pcap file, which keeps one turn in memory.

    The first and the last turn may lack columns. A packet that arrives after one of the next turn is left out. Its
    columns count as missing, as do those that the sensor marks as invalid.

    Parameters
    ----------
    file : binary file
    metadata : those of the sensor
    port : UDP port to which the packets were sent; None: any, if all packets come from one sensor.

    Raises
    ------
    CloudReadError
        The file is not a pcap file. It has no packets of the size that follows from the metadata, or packets of another
        sensor, or of several sensors. The error comes at the first step of the iteration, or at the packet.
    """
    layout = PacketLayout(metadata)
    turn: _Columns | None = None
    finished: int | None = None
    for payload in _lidar_packets(file, layout, port):
        columns = layout.columns(payload)
        frames = layout.frames(payload, columns)
        for frame in dict.fromkeys(frames.tolist()):
            if frame == finished:
                continue
            if turn is None or frame != turn.frame:
                if turn is not None:
                    finished = turn.frame
                    if (whole := turn.turn()) is not None:
                        yield whole
                turn = _Columns(metadata, frame)
            turn.add(columns[frames == frame])
    last = turn.turn() if turn is not None else None
    if last is not None:
        yield last


def _lidar_packets(file: IO[bytes], layout: PacketLayout, port: int | None) -> Iterator[bytes]:
    """Payloads of the packets with ranges, all from one sensor."""
    sender: tuple[str, int] | None = None
    sizes: set[int] = set()
    for datagram in datagrams(file):
        if port is not None and datagram.port != port:
            continue
        if not layout.is_lidar(datagram.payload):
            if len(sizes) < 5:
                sizes.add(len(datagram.payload))
            continue
        sender = sender or (datagram.source, datagram.port)
        _check_sender(datagram, sender, layout)
        yield datagram.payload
    if sender is None:
        found = f"datagrams of {', '.join(map(str, sorted(sizes)))} bytes" if sizes else "no UDP datagrams"
        to_port = "" if port is None else f" to port {port}"
        raise CloudReadError(f"expected packets of {layout.size} bytes{to_port}, as the metadata state, got {found}")


def _check_sender(datagram: Datagram, sender: tuple[str, int], layout: PacketLayout) -> None:
    """Raise CloudReadError if a packet comes from another sensor than the metadata."""
    if (datagram.source, datagram.port) != sender:
        raise CloudReadError(
            f"the recording has packets of several sensors, from {sender[0]} to port {sender[1]} and from "
            f"{datagram.source} to port {datagram.port}; name the port of one"
        )
    known, serial = layout.metadata.serial, layout.serial(datagram.payload)
    if known and serial and serial != known:
        raise CloudReadError(f"this was recorded from sensor {serial}, but the metadata are those of {known}")


class _Columns:
    """Buffer for the columns of a turn, which arrive packet by packet."""

    def __init__(self, metadata: SensorMetadata, frame: int) -> None:
        self.metadata, self.frame = metadata, frame
        w, h = metadata.columns, metadata.rings
        self.words = np.zeros((w, h, PROFILES[metadata.profile].words), dtype=np.uint32)
        self.time_ns = np.zeros(w, dtype=np.uint64)
        self.is_there = np.zeros(w, dtype=bool)

    def add(self, columns: np.ndarray) -> None:
        """Add those columns that the sensor marks as valid."""
        columns = columns[(columns["status"] & 1) == 1]
        places = columns["column"]
        if places.size and places.max() >= self.metadata.columns:
            raise CloudReadError(
                f"the recording has a column of number {places.max()}, "
                f"but the metadata state {self.metadata.columns} columns"
            )
        self.words[places], self.time_ns[places], self.is_there[places] = columns["words"], columns["time"], True

    def turn(self) -> OusterTurn | None:
        """The turn; None if it has no valid column."""
        if not self.is_there.any():
            return None
        metadata, fields = self.metadata, PROFILES[self.metadata.profile].fields
        values = {name: np.ascontiguousarray(field.read(self.words).T) for name, field in fields.items()}
        millimetres = _returns(values, "range", np.uint32)
        assert millimetres is not None
        ranges = millimetres / 1000 - metadata.beam_origin_distance_m
        ranges[(millimetres == 0) | (ranges <= 0)] = np.nan
        start_ns = int(self.time_ns[self.is_there].min())
        elapsed_s = np.where(self.is_there, (self.time_ns - np.uint64(start_ns)).astype(np.float64) * 1e-9, np.nan)
        return OusterTurn(
            frame=self.frame,
            start_ns=start_ns,
            time_s=elapsed_s,
            range_m=ranges.astype(np.float32),
            reflectivity=_returns(values, "reflectivity", np.uint16),
            signal=_returns(values, "signal", np.uint16),
            near_ir=values["near_ir"].astype(np.uint16) if "near_ir" in values else None,
        )


def _returns(values: dict[str, NDArray[np.uint32]], name: str, kind: type[Any]) -> Any:
    """(k, h, w) values of all returns; None if the profile does not have them."""
    found = [values[key] for key in (name, f"{name}2") if key in values]
    return np.stack(found).astype(kind) if found else None


def columns_of_directions(pixel_shift: NDArray[np.int64], w: int) -> NDArray[np.int64]:
    """Columns, (h, w) int64, from which each row takes its pixels so that a column has one direction (destaggering)."""
    return np.asarray((np.arange(w) - pixel_shift[:, None]) % w)
