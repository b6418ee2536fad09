"""Make the recordings and sounds of the golden comparison in the current folder."""

from pathlib import Path

import numpy as np
import soundfile

import gesturekit as gk

SECONDS, RATE = 4.0, 16_000


def main() -> None:
    """Write corpus/STYLE_N.wav + .bvh, speech.wav, unpaired/, broken files and tables."""
    model = gk.load("demo")
    whole, rate = soundfile.read(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    Path("corpus").mkdir()
    Path("unpaired").mkdir()
    for number, name in enumerate(["calm_1", "calm_2", "lively_1", "lively_2", "lively_3"]):
        start = int(number * 2.0 * rate)
        sound = whole[start : start + int(SECONDS * rate)]
        soundfile.write(f"corpus/{name}.wav", sound, rate)
        motion = model.generate((sound.astype(np.float32), rate), seed=number)
        motion.save(f"corpus/{name}.bvh")
    soundfile.write("speech.wav", whole[: int(3 * rate)], rate)
    soundfile.write("unpaired/u.wav", whole[int(6 * rate) : int(11 * rate)], rate)
    Path("broken.wav").write_text("no sound", encoding="utf-8")
    Path("broken.bvh").write_text("HIERARCHY\nROOT a\n", encoding="utf-8")
    Path("empty").mkdir()
    rows = "".join(f"{k / 10:.1f},0,{k / 20:.2f}\n" for k in range(31))
    Path("path.csv").write_text("time,x,z\n" + rows, encoding="utf-8")
    Path("study.yaml").write_text(
        "title: Which?\ndesign: preference\nsystems: {one: corpus, two: corpus}\n"
        "audio: corpus\npairs: 3\nattention_checks: 0\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
