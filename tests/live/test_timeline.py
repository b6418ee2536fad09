import numpy as np
import pytest

from gesturekit.live.sources import BRIDGE, Block, Timeline

RATE, SIZE = 16_000, 640
TONE = np.sin(np.arange(40 * SIZE) / 9).astype(np.float32)


def blocks(times: dict[int, float]) -> list[Block]:
    """Blocks of a tone by number, and the second at which each was captured."""
    return [Block(TONE[k * SIZE : (k + 1) * SIZE], time) for k, time in times.items()]


def placed(line: Timeline, block: Block, waited: float = 0.0) -> np.ndarray:
    """Place a block that waited some seconds after its last sample."""
    return line.place(block, (block.time or 0.0) + 0.04 + waited)


def counts(line: Timeline) -> dict[str, float]:
    """Seconds of sound of each fate that some had."""
    return {name: seconds for name, seconds in line.counts.items() if seconds > 1e-6}


@pytest.mark.parametrize("ppm", [-200, 200])
def test_five_minutes_of_a_clock_that_drifts_are_no_gap_and_no_delay(ppm):
    """The sound card counts 16,000 samples in a little more or less than a second."""
    line, length = Timeline(RATE, 0.02), 0.04 * (1 + ppm * 1e-6)
    rng = np.random.default_rng(0)
    block = np.zeros(SIZE, np.float32)
    n_blocks = 300 * 25
    for k, jitter in enumerate(rng.uniform(-0.005, 0.005, n_blocks).tolist()):
        assert len(placed(line, Block(block, 100 + k * length + jitter))) == SIZE
        if k % 7 == 0:
            assert not len(line.idle(100 + (k + 1) * length + 0.15))
    assert counts(line) == {}
    assert line.moment(line.seconds) == pytest.approx(100 + n_blocks * length, abs=0.01)


def test_a_source_that_stalls_gives_fading_sound_and_then_silence():
    line = Timeline(RATE, 0.02)
    for block in blocks({k: 5 + 0.04 * k for k in range(5)}):
        placed(line, block)
    assert not len(line.idle(5.2 + BRIDGE))
    idle = np.concatenate([line.idle(now) for now in np.arange(5.42, 6.42, 0.05)])
    assert line.seconds == pytest.approx(0.2 + len(idle) / RATE)
    assert line.seconds == pytest.approx(6.37 - 5 - BRIDGE, abs=0.03)
    assert np.abs(idle[:3200]).max() > 0.5 and not idle[3200:].any()
    # What was on its way when silence had begun is late; what is said now is taken.
    late, now = blocks({5: 5.2, 6: 6.4})
    assert not len(placed(line, late))
    assert placed(line, now)[-SIZE:].tolist() == now.samples.tolist()
    assert line.counts["dropped"] == pytest.approx(0.04)


def test_a_gap_that_no_silence_could_fill_is_skipped():
    """The computer slept for an hour: the stream goes on with the present."""
    line = Timeline(RATE, 0.02)
    placed(line, blocks({0: 0.0})[0])
    assert len(placed(line, blocks({1: 3600.0})[0])) == BRIDGE * RATE + SIZE
    assert line.moment(line.seconds) == pytest.approx(3600.04)
    assert line.counts["bridged"] == pytest.approx(BRIDGE)
    assert line.counts["skipped"] == pytest.approx(3600 - 0.04 - BRIDGE)
    assert 0 < len(line.idle(9000.0)) < 10 * RATE
    assert line.moment(line.seconds) == pytest.approx(9000 - BRIDGE, abs=0.03)


def test_a_gap_is_not_filled_while_the_computer_is_behind():
    line = Timeline(RATE, 0.02)
    first, later = blocks({0: 0.0, 5: 0.2})
    placed(line, first)
    assert len(placed(line, later, waited=0.4)) == SIZE
    assert counts(line) == pytest.approx({"skipped": 0.16})


def test_what_fills_a_gap_to_the_last_sample():
    """Twenty samples a second, of which four are mirrored: 6 5 4 3 times 1, 3/4, 1/2, 1/4."""
    line = Timeline(20, 0.25)
    assert not len(line.idle(10.0)) and line.moment(0.0) == 10.0
    # 0.3 s of sound are due after 0.2 s of patience and 0.25 s of tolerance: at first silence.
    np.testing.assert_array_equal(line.idle(10.75), np.zeros(6))
    line = Timeline(20, 0.25)
    sound = np.arange(1, 7, dtype=np.float32)
    np.testing.assert_array_equal(line.place(Block(sound, 10.0), 10.3), sound)
    assert line.seconds == pytest.approx(0.3)
    np.testing.assert_allclose(line.idle(10.9), [6, 3.75, 2])
    assert counts(line) == pytest.approx({"bridged": 0.15})
    np.testing.assert_allclose(line.idle(11.0), [0.75, 0])
    assert counts(line) == pytest.approx({"bridged": 0.2, "silent": 0.05})
    assert line.seconds == pytest.approx(0.55) and line.moment(0.5) == 10.5
    # What follows is mirrored anew, with what was before it.
    line.place(Block(sound[:2] * 10, 10.55), 10.65)
    np.testing.assert_allclose(line.idle(11.5)[:5], [20, 7.5, 3, 1.25, 0])
