# SPDX-License-Identifier: Apache-2.0
"""UDP datagrams of a recorded network traffic (pcap), read one by one.

Sources: the capture file of libpcap ("pcap-savefile", tcpdump.org; draft-ietf-opsawg-pcap), IPv4 (RFC 791) with its
fragments, UDP (RFC 768). IPv6 and other protocols than UDP are left out.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Iterator
from typing import IO, NamedTuple

from pcgraph.errors import CloudReadError

MAX_RECORD = 262_144
"""Largest record, bytes. Source: libpcap's limit for networks, MAXIMUM_SNAPLEN."""
MAX_PENDING = 64
"""Largest count of incomplete datagrams that are kept. A sensor sends the fragments of one datagram after the other, so
that more are needed for several sensors only. Chosen by eye; not varied."""
MAX_DATAGRAM = 65_535
"""Largest IPv4 packet, and so the largest sum of its fragments, bytes, because its length has 16 bits (RFC 791)."""
_MAGIC = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">", b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
"""Byte order by the first four bytes of a file; the last two belong to files with times in nanoseconds."""
_NEXT_GENERATION = b"\x0a\x0d\x0d\x0a"
"""First four bytes of pcapng, the other format that Wireshark writes."""
_LINK_HEADERS = {0: 4, 1: 14, 101: 0, 113: 16, 228: 0, 276: 20}
"""Number of bytes before the IP packet, by type of link: BSD loopback, Ethernet, raw IP, Linux cooked, IPv4, Linux
cooked 2."""
_VLAN = (0x8100, 0x88A8)
"""Types of Ethernet frames with a tag of a virtual network: four more bytes before the type of their content. Source:
IEEE 802.1Q and 802.1ad."""
_UDP = 17
"""Protocol number of UDP in an IP header. Source: IANA."""


class Datagram(NamedTuple):
    """A UDP datagram.

    Attributes
    ----------
    source : str
        Address of the sender.
    port : int
        Port to which the datagram was sent.
    payload : bytes
    """

    source: str
    port: int
    payload: bytes


def datagrams(file: IO[bytes]) -> Iterator[Datagram]:
    """Iterator over the UDP datagrams of an open pcap file, in the file's order, joined from their fragments.

    A recording that was interrupted may end within a record; that record is left out. So are datagrams that the
    recording truncated, and those that lost a fragment.

    Raises
    ------
    CloudReadError
        The file is not a pcap file, or a record is damaged. The error comes at the first step of the iteration, or at
        the record.

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
    """Byte order of a pcap file, and its type of link."""
    header = file.read(24)
    if header[:4] == _NEXT_GENERATION:
        raise CloudReadError("this is a pcapng file; convert it to pcap, for example with editcap -F pcap")
    order = _MAGIC.get(header[:4], "")
    if len(header) < 24 or not order:
        raise CloudReadError("this is no pcap file: it does not begin as one")
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
    """Fragments of incomplete datagrams, in the order of their first fragments."""

    def __init__(self) -> None:
        self.pending: OrderedDict[bytes, tuple[dict[int, bytes], list[int]]] = OrderedDict()

    def whole(self, packet: memoryview) -> Datagram | None:
        """The datagram in an IPv4 packet, or the one that it completes; None if there is none or parts are missing."""
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
    """The joined fragments, given by their offsets; None if they leave a gap or overlap."""
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
