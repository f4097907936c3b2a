"""Records in shared memory: whole, newest, and there whatever became of their writer."""

from __future__ import annotations

import threading

import numpy as np

from robotcell.io.shared_record import SharedRecord, record_size

PAIR = np.dtype([("a", "f8", 100), ("b", "f8"), ("kept", "i4")])


def test_what_is_written_is_read_and_the_rest_is_kept() -> None:
    memory = memoryview(bytearray(16 + record_size(PAIR)))
    writer, reader = SharedRecord(PAIR, memory, 16), SharedRecord(PAIR, memory, 16)
    assert reader.read()["b"] == 0
    writer.write(b=2.0, kept=7)
    writer.write(a=np.full(100, 3.0))
    record = reader.read()
    assert record["b"] == 2.0
    assert record["kept"] == 7
    assert (record["a"] == 3.0).all()
    writer.write(b=4.0)
    assert record["b"] == 2.0, "a record that was read does not change"
    assert record_size(PAIR) % 8 == 0


def test_a_record_is_never_a_mixture_of_two() -> None:
    memory = memoryview(bytearray(record_size(PAIR)))
    writer, reader = SharedRecord(PAIR, memory), SharedRecord(PAIR, memory)
    done = threading.Event()

    def write() -> None:
        value = 0.0
        while not done.is_set():
            value += 1.0
            writer.write(a=np.full(100, value), b=value)

    thread = threading.Thread(target=write)
    thread.start()
    seen = [reader.read() for _ in range(3000)]
    done.set()
    thread.join()
    assert all((record["a"] == record["b"]).all() for record in seen)
    values = [float(record["b"]) for record in seen]
    assert values == sorted(values)
