from __future__ import annotations

import numpy as np
import pytest

from gesturekit.live.timeline import Block, Timeline

RATE, SIZE = 16_000, 640
TONE = np.sin(np.arange(40 * SIZE) / 9).astype(np.float32)


def blocks(times: dict[int, float]) -> list[Block]:
    """Blocks of a tone by number, and the second at which each was captured."""
    return [Block(TONE[k * SIZE : (k + 1) * SIZE], time) for k, time in times.items()]


def placed(line: Timeline, block: Block, waited: float = 0.0) -> np.ndarray:
    """Place a block that waited some seconds after its last sample."""
    return line.place(block, (block.time or 0.0) + 0.04 + waited)


def counts(line: Timeline) -> list[float]:
    return [round(seconds, 6) for seconds in line.counts().values()]


@pytest.mark.parametrize("ppm", [-200, 200])
def test_an_hour_of_a_clock_that_drifts_is_no_gap_and_no_delay(ppm):
    """The sound card counts 16,000 samples in a little more or less than a second."""
    line, length = Timeline(RATE, 0.02), 0.04 * (1 + ppm * 1e-6)
    rng = np.random.default_rng(0)
    block = np.zeros(SIZE, np.float32)
    n_blocks = 3600 * 25
    for k, jitter in enumerate(rng.uniform(-0.005, 0.005, n_blocks).tolist()):
        assert len(placed(line, Block(block, 100 + k * length + jitter))) == SIZE
        if k % 7 == 0:
            assert not len(line.idle(100 + (k + 1) * length + 0.15))
    assert counts(line) == [0, 0, 0, 0]
    assert line.moment(line.seconds) == pytest.approx(100 + n_blocks * length, abs=0.01)


def test_a_lost_block_is_bridged_by_sound_that_fades():
    line = Timeline(RATE, 0.02)
    given = [placed(line, block) for block in blocks({k: 0.04 * k for k in range(10) if k != 6})]
    whole = np.concatenate(given)
    assert len(whole) == 10 * SIZE and counts(line) == [0.04, 0, 0, 0]
    np.testing.assert_array_equal(whole[7 * SIZE :], TONE[7 * SIZE : 10 * SIZE])
    bridge = whole[6 * SIZE : 7 * SIZE]
    # The mirror image of what was before, no jump at its start, and down by 0.04 of 0.2 s.
    np.testing.assert_allclose(bridge[0], whole[6 * SIZE - 1], atol=1e-3)
    mirrored = whole[5 * SIZE : 6 * SIZE][::-1] * np.linspace(1, 0.8, SIZE)
    np.testing.assert_allclose(bridge, mirrored, atol=2e-3)
    # The next gap is bridged anew.
    again = placed(line, Block(TONE[11 * SIZE : 12 * SIZE], 0.44))
    np.testing.assert_allclose(again[:50], whole[::-1][:50], atol=0.02)


def test_a_source_that_stalls_gives_fading_sound_and_then_silence():
    line = Timeline(RATE, 0.02)
    for block in blocks({k: 5 + 0.04 * k for k in range(5)}):
        placed(line, block)
    assert not len(line.idle(5.2 + 0.219))
    idle = np.concatenate([line.idle(now) for now in np.arange(5.42, 6.42, 0.05)])
    assert line.seconds == pytest.approx(0.2 + len(idle) / RATE)
    assert line.seconds == pytest.approx(6.37 - 5 - 0.22, abs=1e-3)
    assert np.abs(idle[:3200]).max() > 0.5 and not idle[3200:].any()
    # What was on its way when silence had begun is late; what is said now is taken.
    late, now = blocks({5: 5.2, 6: 6.4})
    assert not len(placed(line, late))
    assert placed(line, now)[-SIZE:].tolist() == now.samples.tolist()
    assert line.counts()["dropped"] == pytest.approx(0.04)


def test_a_gap_that_no_silence_could_fill_is_skipped():
    """The computer slept for an hour: the stream goes on with the present."""
    line = Timeline(RATE, 0.02)
    placed(line, blocks({0: 0.0})[0])
    assert len(placed(line, blocks({1: 3600.0})[0])) == 0.2 * RATE + SIZE
    assert line.moment(line.seconds) == pytest.approx(3600.04)
    assert counts(line)[::3] == [0.2, round(3600 - 0.04 - 0.2, 6)]
    assert len(line.idle(9000.0)) == RATE
    assert line.moment(line.seconds) == pytest.approx(9000 - 0.22)


def test_a_gap_is_not_filled_while_the_computer_is_behind():
    line = Timeline(RATE, 0.02)
    first, later = blocks({0: 0.0, 5: 0.2})
    placed(line, first)
    assert len(placed(line, later, waited=0.4)) == SIZE
    assert counts(line) == [0, 0, 0, 0.16]


def test_sound_without_a_clock_is_taken_as_it_is():
    line = Timeline(RATE, 0.02)
    given = [placed(line, block) for block in blocks(dict.fromkeys(range(8)))]
    np.testing.assert_array_equal(np.concatenate(given), TONE[: 8 * SIZE])
    assert line.moment(1.0) is None


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
    assert line.counts() == pytest.approx(
        {"bridged": 0.15, "silent": 0, "dropped": 0, "skipped": 0}
    )
    np.testing.assert_allclose(line.idle(11.0), [0.75, 0])
    assert line.counts() == pytest.approx(
        {"bridged": 0.2, "silent": 0.05, "dropped": 0, "skipped": 0}
    )
    assert line.seconds == pytest.approx(0.55) and line.moment(0.5) == 10.5
    # What follows is mirrored anew, with what was before it.
    line.place(Block(sound[:2] * 10, 10.55), 10.65)
    np.testing.assert_allclose(line.idle(11.5)[:5], [20, 7.5, 3, 1.25, 0])


def test_a_difference_up_to_the_tolerance_is_drift():
    """A clock is followed by a thousandth of the sound at most: of 0.25 s by 0.25 ms."""
    quarter = np.ones(4000, np.float32)
    for time, moved in ((0.0, -2.5e-4), (0.5, 2.5e-4), (0.2499, -1e-4), (0.2501, 1e-4)):
        line = Timeline(RATE, 0.25)
        line.place(Block(quarter, 0.0), 0.25)
        assert len(line.place(Block(quarter, time), time + 0.25)) == 4000
        assert line.moment(0.0) == pytest.approx(moved, abs=1e-9) and counts(line) == [0] * 4


def test_of_sound_that_is_late_in_part_the_rest_is_taken():
    line = Timeline(RATE, 0.02)
    half = np.arange(8000, dtype=np.float32)
    line.place(Block(half, 0.0), 0.5)
    np.testing.assert_array_equal(line.place(Block(half, 0.25), 0.75), half[4000:])
    assert counts(line) == [0, 0, 0.25, 0] and line.seconds == 0.75


@pytest.mark.parametrize(("waited", "filled"), [(0.1, 0.125), (0.3, 0.0)])
def test_a_long_block_is_behind_only_if_it_waited(waited, filled):
    """It takes half a second to say half a second, and an eighth is missing before it."""
    line = Timeline(RATE, 0.02)
    half = np.ones(8000, np.float32)
    line.place(Block(half, 0.0), 0.5)
    assert len(line.place(Block(half, 0.625), 1.125 + waited)) == 8000 + RATE * filled
    assert counts(line) == [filled, 0, 0, 0.125 - filled]
