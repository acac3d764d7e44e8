"""How fast a log becomes columns, compared with the least possible work and the plain reader.

    python tests/benchmarks/bench_ingest.py [--frames 200000] [--encoding protobuf]

CPU seconds of all threads, medians of alternating runs. "raw" reads the same file, decompresses
its chunks and checks them, and does nothing else. "plain" is the reader of the `mcap` package
with the public decoder of the encoding, which makes an object per message. "plain to columns"
also puts the centroids of those objects into four arrays. "epipole" gives checked tables and the
SHA-256 of the file.
"""

import argparse
import json
import logging
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from epipole.io.logs.messages.registry import ENCODINGS
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter

START_NS = 1_554_091_200_000_000_000
FRAME_NS = 200_000_000
CENTROIDS = 25
SENSORS = 4
CAMERA = {
    **dict.fromkeys(("width", "height"), 2048),
    **dict.fromkeys(("fx_px", "fy_px"), 1e4),
    **dict.fromkeys(("cx_px", "cy_px"), 1023.5),
    **dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0),
}


def write_log(path: Path, n_frames: int, encoding: str) -> None:
    """Write a log of four sensors: frames at 5 Hz, of random centroids, states at 1 Hz."""
    rng = np.random.default_rng(0)
    names = [f"sat{s + 1}" for s in range(SENSORS)]
    with LogWriter(path, encoding=encoding) as log:
        for name in names:
            log.camera(name, START_NS, CAMERA)
        for i in range(n_frames):
            number, s = divmod(i, SENSORS)
            time_ns, n = START_NS + number * FRAME_NS, rng.poisson(CENTROIDS)
            if number % 5 == 0:
                log.state(
                    names[s],
                    time_ns,
                    position_km=[7000.0, number * 1e-3, s],
                    velocity_km_s=[0.0, 7.5, 1.0],
                    attitude_xyzw=[0.0, 0.0, 0.6, 0.8],
                    attitude_sigma_arcsec=30.0,
                )
            log.frame(
                names[s],
                time_ns,
                frame_number=number,
                exposure_s=0.1,
                x_px=rng.uniform(0, 2047, n),
                y_px=rng.uniform(0, 2047, n),
                flux=rng.lognormal(7, 1, n),
                sigma_px=rng.uniform(0.05, 0.3, n),
            )


def raw(path: Path) -> None:
    """Read a file, decompress its chunks and check them."""
    data = memoryview(path.read_bytes())
    at = 8
    while True:
        opcode, length = struct.unpack_from("<BQ", data, at)
        body, at = at + 9, at + 9 + length
        if opcode == 0x0F:
            return
        if opcode == 0x06:
            _, _, size, checksum, name = struct.unpack_from("<QQQII", data, body)
            chunk = data[body + 40 + name : at]
            records = zstandard.ZstdDecompressor().decompress(chunk, max_output_size=size)
            if zlib.crc32(records) != checksum:
                raise ValueError("a chunk of the benchmark's own log is damaged")


def decoded(path: Path, encoding: str) -> Iterator[Any]:
    """Yield every message, decoded with the public packages."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        if encoding == "json":
            for _, _, message in make_reader(file).iter_messages():
                yield json.loads(message.data)
            return
        if encoding == "protobuf":
            from mcap_protobuf.decoder import DecoderFactory
        else:
            from mcap_ros2.decoder import DecoderFactory
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, _, message in reader.iter_decoded_messages():
            yield message


def plain(path: Path, encoding: str) -> None:
    """Decode every message."""
    for _ in decoded(path, encoding):
        pass


def plain_to_columns(path: Path, encoding: str) -> None:
    """Decode every message, and put the centroids of all frames into four arrays."""
    columns: dict[str, list[Any]] = {name: [] for name in ("x_px", "y_px", "flux", "sigma_px")}
    for message in decoded(path, encoding):
        values = message if isinstance(message, dict) else None
        if "x_px" in values if values is not None else hasattr(message, "x_px"):
            for name, column in columns.items():
                numbers = values[name] if values is not None else getattr(message, name)
                column.append(np.array(numbers, np.float32))
    for column in columns.values():
        np.concatenate(column)


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the CPU seconds, of all threads, that a piece of work takes."""
    started = time.process_time()
    work()
    return time.process_time() - started


def peak_mib(path: Path) -> list[float]:
    """Return the memory [MiB]: before reading, the peak while reading, and of the columns."""
    command = [sys.executable, __file__, "--peak", str(path)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [float(number) for number in out.split()]


def print_peak(path: str) -> None:
    """Print what `peak_mib` returns; called in a process that does nothing else."""
    logging.disable()
    before = resident_mib()
    log = read_log(path)
    print(before, resident_mib(), (log.exposures.nbytes + log.states.nbytes) / 2**20)


def resident_mib() -> float:
    """Return the peak memory of this process, without its parent (Linux)."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    """Print a row of the table in BENCHMARKS.md."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--frames", type=int, default=200_000)
    arguments.add_argument("--encoding", default="protobuf", choices=[*ENCODINGS])
    arguments.add_argument("--runs", type=int, default=7)
    arguments.add_argument("--peak", metavar="LOG", help="print the memory that reading takes")
    chosen = arguments.parse_args()
    if chosen.peak:
        print_peak(chosen.peak)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "night.mcap"
        write_log(path, chosen.frames, chosen.encoding)
        times = measure(path, chosen.encoding, chosen.runs)
        before, peak, columns = peak_mib(path)
        size = path.stat().st_size / 1e6
    raw_s, own_s, plain_s, columns_s = (statistics.median(t) for t in times)
    print(f"{chosen.encoding}, {chosen.frames:,} frames, {size:.0f} MB")
    print(f"  CPU s: raw {raw_s:.3f}, epipole {own_s:.3f}, plain {plain_s:.2f}, {columns_s:.2f}")
    print(f"  {chosen.frames / own_s:,.0f} frames/s, {raw_s / own_s:.2f} of raw speed,")
    print(f"  {plain_s / own_s:.1f} x plain, {columns_s / own_s:.1f} x plain to columns")
    print(f"  MiB: {before:.0f} before, {peak - before:.0f} more at most, columns {columns:.0f}")


def measure(path: Path, encoding: str, runs: int) -> list[list[float]]:
    """Return the CPU seconds of raw, epipole, plain and plain to columns, of each run."""
    read_log(path)  # kernels are compiled, the file is cached
    read_log(path)
    times: list[list[float]] = [[], [], [], []]
    for run in range(runs):
        times[0].append(cpu_seconds(lambda: raw(path)))
        times[1].append(cpu_seconds(lambda: read_log(path)))
        if run < 3:
            times[2].append(cpu_seconds(lambda: plain(path, encoding)))
            times[3].append(cpu_seconds(lambda: plain_to_columns(path, encoding)))
    return times


if __name__ == "__main__":
    main()
