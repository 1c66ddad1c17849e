# SPDX-License-Identifier: Apache-2.0
"""UDP datagrams of a recording of network traffic (pcap), one after the other, in little memory.

The formats: the capture file of libpcap ("pcap-savefile", tcpdump.org; draft-ietf-opsawg-pcap), IPv4 (RFC 791) with
its fragments, UDP (RFC 768). IPv6 and what is no UDP are left out.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Iterator
from typing import IO, NamedTuple

from pcgraph.errors import CloudReadError

MAX_RECORD = 262_144
"""Largest number of bytes of one record: libpcap's own limit (its MAXIMUM_SNAPLEN for networks)."""
MAX_PENDING = 64
"""Largest number of datagrams whose fragments are waited for. A sensor sends one after the other, and a datagram that
lost a fragment never becomes whole; 64 are enough for several sensors at once."""
MAX_DATAGRAM = 65_535
"""Largest number of bytes of an IPv4 packet, and therefore of its fragments together (RFC 791)."""
_MAGIC = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">", b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
"""First four bytes of a file, and the order of bytes that they mean; the last two are of times in nanoseconds."""
_NEXT_GENERATION = b"\x0a\x0d\x0d\x0a"
"""First four bytes of the other format that Wireshark writes, pcapng."""
_LINK_HEADERS = {0: 4, 1: 14, 101: 0, 113: 16, 228: 0, 276: 20}
"""Number of bytes before the IP packet, by type of link: BSD loopback, Ethernet, raw IP, Linux cooked, IPv4, Linux
cooked 2."""
_VLAN = (0x8100, 0x88A8)
"""Types of Ethernet frames with a tag of a virtual network (IEEE 802.1Q, 802.1ad): they have four more bytes before the
type of what they carry."""
_UDP = 17
"""Number of UDP among the protocols of IP (IANA)."""


class Datagram(NamedTuple):
    """A UDP datagram.

    source, port : the sender's address as text, and the port that the datagram was sent to.
    payload : the bytes.
    """

    source: str
    port: int
    payload: bytes


def datagrams(file: IO[bytes]) -> Iterator[Datagram]:
    """Iterator over the whole UDP datagrams of an open pcap file, in its order; fragments are put together.

    A file that ends within a record ends there: so does a recording that was interrupted. Datagrams that the recording
    cut short or that lost a fragment are left out.

    Raises
    ------
    CloudReadError
        The file is no pcap file, or a record is damaged; it is raised at the first step of the iteration, or where the
        record is met.

    Examples
    --------
    >>> import io, struct
    >>> udp = struct.pack(">HHHH", 7502, 7502, 13, 0) + b"hello"
    >>> ip = struct.pack(">BBHHHBBH4s4s", 69, 0, 33, 1, 0, 64, 17, 0, bytes([10, 0, 0, 1]), bytes([10, 0, 0, 2])) + udp
    >>> header = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)
    >>> list(datagrams(io.BytesIO(header + struct.pack("<IIII", 0, 0, 33, 33) + ip)))
    [Datagram(source='10.0.0.1', port=7502, payload=b'hello')]
    """
    order, link = _file_header(file)
    fragments = _Fragments()
    for record in _records(file, order):
        packet = _ip_packet(record, link)
        datagram = fragments.whole(packet) if packet else None
        if datagram:
            yield datagram


def _file_header(file: IO[bytes]) -> tuple[str, int]:
    """Order of bytes and type of link."""
    header = file.read(24)
    if header[:4] == _NEXT_GENERATION:
        raise CloudReadError("this is a pcapng file; convert it to pcap, for example with editcap -F pcap")
    order = _MAGIC.get(header[:4], "")
    if len(header) < 24 or not order:
        raise CloudReadError("this is no pcap file: it does not start as one")
    link: int = struct.unpack(order + "I", header[20:24])[0] & 0xFFFF  # the upper bits tell of checksums
    if link not in _LINK_HEADERS:
        raise CloudReadError(f"expected packets of Ethernet, raw IP or Linux cooked capture, got link {link}")
    return order, link


def _records(file: IO[bytes], order: str) -> Iterator[bytes]:
    """The recorded bytes of each packet that was not cut short."""
    while len(header := file.read(16)) == 16:
        stored, sent = struct.unpack(order + "II", header[8:])
        if not 0 < stored <= MAX_RECORD:
            raise CloudReadError(f"the recording is damaged: a record states {stored} bytes, not 1 to {MAX_RECORD}")
        record = file.read(stored)
        if len(record) < stored:
            return
        if stored >= sent:
            yield record


def _ip_packet(record: bytes, link: int) -> memoryview | None:
    """The IPv4 packet in a record of a link; None if there is none."""
    start = _LINK_HEADERS[link]
    if link == 1:
        while int.from_bytes(record[start - 2 : start], "big") in _VLAN:
            start += 4
    packet = memoryview(record)[start:]
    return packet if len(packet) >= 20 and packet[0] >> 4 == 4 else None


class _Fragments:
    """Fragments of datagrams that are not whole yet. The datagrams are in the order of their first fragments."""

    def __init__(self) -> None:
        self.pending: OrderedDict[bytes, tuple[dict[int, bytes], list[int]]] = OrderedDict()

    def whole(self, packet: memoryview) -> Datagram | None:
        """The datagram that an IPv4 packet is or completes; None if it is none, or some of it is missing."""
        header, total = 4 * (packet[0] & 15), int.from_bytes(packet[2:4], "big")
        if packet[9] != _UDP or header < 20 or not header <= total <= len(packet):
            return None
        content = bytes(packet[header:total])
        source = ".".join(map(str, packet[12:16]))
        flags = int.from_bytes(packet[6:8], "big")
        offset, has_more = 8 * (flags & 0x1FFF), bool(flags & 0x2000)
        if offset == 0 and not has_more:
            return _datagram(source, content)
        if offset + len(content) > MAX_DATAGRAM:
            return None
        key = bytes(packet[12:20]) + bytes(packet[4:6])  # addresses and identification
        parts, size = self.pending.setdefault(key, ({}, []))
        parts[offset] = content
        if not has_more:
            size.append(offset + len(content))
        if len(self.pending) > MAX_PENDING:
            self.pending.popitem(last=False)
        joined = _joined(parts, size[-1]) if size else None
        if joined is None:
            return None
        self.pending.pop(key, None)
        return _datagram(source, joined)


def _joined(parts: dict[int, bytes], size: int) -> bytes | None:
    """Fragments by their offset as one; None unless they follow each other without gap or overlap."""
    joined = bytearray()
    for offset in sorted(parts):
        if offset != len(joined):
            return None
        joined += parts[offset]
    return bytes(joined) if len(joined) == size else None


def _datagram(source: str, content: bytes) -> Datagram | None:
    """The datagram in the content of an IP packet."""
    if len(content) < 8:
        return None
    _, port, length = struct.unpack(">HHH", content[:6])
    return Datagram(source, port, content[8:length]) if 8 <= length <= len(content) else None
