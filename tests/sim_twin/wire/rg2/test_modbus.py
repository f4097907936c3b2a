import asyncio
import socket
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_twin.wire.rg2.modbus import ModbusServer, Refusal, RefusedError, answer, split_frames
from tests.addresses import loopback

PDUS = st.binary(min_size=1, max_size=253)
# Mostly function codes that exist, with plausible numbers.
REQUESTS = st.one_of(
    PDUS,
    st.builds(
        lambda function, body: bytes([function]) + body,
        st.sampled_from([3, 6, 16, 23]),
        st.lists(st.integers(0, 300), max_size=9).map(lambda v: struct.pack(f">{len(v)}H", *v)),
    ),
)


class Ten:
    """Unit 65 with registers 0 to 9, of which 0 to 4 can be written with values below 100."""

    def __init__(self):
        self.registers = list(range(10))

    def answers(self, unit):
        return unit == 65

    def read(self, unit, address, count):
        if address + count > 10:
            raise RefusedError(Refusal.ADDRESS)
        return self.registers[address : address + count]

    def write(self, unit, address, values):
        if address + len(values) > 5:
            raise RefusedError(Refusal.ADDRESS)
        if any(value >= 100 for value in values):
            raise RefusedError(Refusal.VALUE)
        self.registers[address : address + len(values)] = values


def frame(pdu, transaction=7, unit=65):
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


@given(st.lists(PDUS, min_size=1, max_size=5), st.data())
def test_frames_are_whole_however_the_bytes_arrive(pdus, data):
    stream = b"".join(frame(pdu) for pdu in pdus)
    received, found, begin = bytearray(), [], 0
    while begin < len(stream):
        end = data.draw(st.integers(begin + 1, len(stream)))
        received += stream[begin:end]
        found += split_frames(received)
        begin = end
    assert found == [frame(pdu) for pdu in pdus]
    assert not received


@pytest.mark.parametrize(
    "data", [b"\x00\x01\x00\x07\x00\x06A", b"\x00\x01\x00\x00\x00\x01A", b"\x00\x01\x00\x00\xff\xffA"]
)
def test_what_is_no_modbus_is_told_from_what_is_not_whole(data):
    with pytest.raises(ValueError, match="not a Modbus"):
        split_frames(bytearray(data))


@given(REQUESTS, st.integers(0, 0xFFFF))
def test_any_request_gets_its_answer_or_an_exception_code(pdu, transaction):
    response = answer(frame(pdu, transaction), Ten())
    number, protocol, length, unit = struct.unpack_from(">HHHB", response)
    assert (number, protocol, unit) == (transaction, 0, 65)
    assert length == len(response) - 6
    assert response[7] in (pdu[0], pdu[0] | 0x80)
    if response[7] & 0x80 and pdu[0] < 0x80:
        assert len(response) == 9
        assert response[8] in set(Refusal)


@pytest.mark.parametrize(
    ("pdu", "response"),
    [
        (struct.pack(">BHH", 3, 8, 2), struct.pack(">BBHH", 3, 4, 8, 9)),
        (struct.pack(">BHH", 3, 9, 2), bytes([0x83, 2])),
        (struct.pack(">BHH", 3, 0, 0), bytes([0x83, 3])),
        (struct.pack(">BHH", 3, 0, 126), bytes([0x83, 3])),
        (struct.pack(">BHH", 6, 1, 42), struct.pack(">BHH", 6, 1, 42)),
        (struct.pack(">BHH", 6, 1, 142), bytes([0x86, 3])),
        (struct.pack(">BHH", 6, 7, 42), bytes([0x86, 2])),
        (struct.pack(">BHHBHH", 16, 1, 2, 4, 50, 51), struct.pack(">BHH", 16, 1, 2)),
        (struct.pack(">BHHBHH", 16, 1, 3, 4, 50, 51), bytes([0x90, 3])),
        (struct.pack(">BHHBHH", 16, 1, 2, 6, 50, 51), bytes([0x90, 3])),
        (struct.pack(">BHHHHBH", 23, 0, 2, 1, 1, 2, 77), struct.pack(">BBHH", 23, 4, 0, 77)),
        (struct.pack(">BHH", 4, 0, 1), bytes([0x84, 1])),
        (bytes([43, 14, 1, 0]), bytes([0xAB, 1])),
    ],
)
def test_answers_as_the_standard_says(pdu, response):
    assert answer(frame(pdu), Ten())[7:] == response


def test_a_write_and_read_that_cannot_read_does_not_write():
    units = Ten()
    assert answer(frame(struct.pack(">BHHHHBH", 23, 9, 2, 1, 1, 2, 77)), units)[7:] == bytes([0x97, 2])
    assert units.registers == list(range(10))


def test_an_unknown_unit_meets_silence():
    assert answer(frame(struct.pack(">BHH", 3, 0, 1), unit=66), Ten()) is None


# The server


HOST = loopback(36)
READ = frame(struct.pack(">BHH", 3, 8, 2))
RESPONSE = frame(struct.pack(">BBHH", 3, 4, 8, 9))


def serve(talk, units=None, **patience):
    """Let clients talk to a server of ten registers."""

    async def run():
        server = ModbusServer(units or Ten(), HOST, 0, **patience)
        await server.open()
        try:
            await asyncio.wait_for(talk(server), 20)
        finally:
            await server.close()

    asyncio.run(run())


async def ask(client):
    reader, writer = client
    writer.write(READ)
    return await reader.read(len(RESPONSE))


async def hang_up(*clients):
    for _, writer in clients:
        writer.close()
        await writer.wait_closed()


def test_a_client_that_never_asks_makes_room_for_the_next():
    async def talk(server):
        first, second = [await asyncio.open_connection(HOST, server.port) for _ in range(2)]
        assert await second[0].read() == b"", "the first one had its time"
        await asyncio.sleep(0.15)
        third = await asyncio.open_connection(HOST, server.port)
        assert await ask(third) == RESPONSE
        assert await first[0].read() == b""
        await hang_up(first, second, third)

    serve(talk, first_request_s=0.1, next_request_s=60)


def test_a_client_that_asks_keeps_its_place():
    async def talk(server):
        first = await asyncio.open_connection(HOST, server.port)
        assert await ask(first) == RESPONSE
        await asyncio.sleep(0.05)
        second = await asyncio.open_connection(HOST, server.port)
        assert await second[0].read() == b""
        assert await ask(first) == RESPONSE
        await hang_up(first, second)

    serve(talk, first_request_s=0.01, next_request_s=60)


def test_a_client_that_never_reads_is_not_listened_to_for_ever():
    units, requests = Counting(), 20_000

    async def talk(server):
        with socket.socket() as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.setblocking(False)
            loop = asyncio.get_running_loop()
            await loop.sock_connect(client, (HOST, server.port))
            sending = asyncio.create_task(loop.sock_sendall(client, READ * requests))
            answered = -1
            while answered != units.reads and units.reads < requests:
                answered = units.reads
                await asyncio.sleep(0.2)
            assert units.reads < requests, "it was listened to all the time"
            # What waits is answered once it reads.
            received = 0
            while received < requests * len(RESPONSE):
                received += len(await loop.sock_recv(client, 1 << 20))
            await sending

    serve(talk, units)


@settings(max_examples=20)
@given(st.lists(st.one_of(st.binary(max_size=40), PDUS.map(frame)), max_size=4).map(b"".join))
def test_after_any_noise_the_next_client_is_served(noise):
    async def talk(server):
        first = await asyncio.open_connection(HOST, server.port)
        first[1].write(noise)
        await hang_up(first)
        while True:
            second = await asyncio.open_connection(HOST, server.port)
            response = await ask(second)
            await hang_up(second)
            if response == RESPONSE:
                return

    serve(talk)


class Counting(Ten):
    """Counts what is read."""

    reads = 0

    def read(self, unit, address, count):
        self.reads += 1
        return super().read(unit, address, count)
