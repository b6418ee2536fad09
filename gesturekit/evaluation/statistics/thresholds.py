"""Thresholds of likeness, of the answers to the three questions and of the verdict, in one table.

Ratios and shares are to the recordings' own value, unless another one is named.
"""

from __future__ import annotations

ABOVE_CHANCE = 3.0
"""Standard errors that a value is above its chance level, at least: of the recordings, for a metric
of speech to be informative; of a model with too few takes for an interval."""
IN_TIME, LOOSELY_IN_TIME, TOO_STRICT = 0.7, 0.3, 1.3
"""Shares of sync above chance: in time with the speech, loosely in time, more than the speaker."""
LATE = 0.2
"""Difference of the lag of sync from the speaker's own, seconds, from which it is named."""

BEYOND_LIMITS = 45.0
"""Percentage of rotations beyond the recordings' range, more than the recordings have themselves,
from which a body is broken. Other speakers, retargeted, have 30 to 60."""
FAR_BEYOND_LIMITS, COVERED, SEPARABLE = 20.0, 0.05, 0.98
"""The same where a motion also covers less than this share of the recordings' own "within reach",
and its 1-NN accuracy is at least this: broken, or of another speaker."""
OUT_OF_JOINT = 75.0
"""Percentage of frames in which one joint of the upper body is far (30°) beyond the recordings'
range, from which a body is broken. Other takes of a speaker have up to 3."""
LEARNED_SECONDS = 25.0
"""Seconds of recordings below which their range says nothing: of two of 10 s, one leaves that
of the other in 7 of 100 cases, of two of 20 s in none."""
FLOATING, SUNK, SLIDING, STRETCHED = 150.0, 100.0, 0.3, 5.0
"""Millimetres that the feet are above the floor or below it, their speed on it in m/s, and the
percentage by which a bone changes its length, above twice those of the recordings, from which a
body is broken. Takes of SHOW stand up to 8 cm apart."""
SHAKEN = 7.5
"""Ratio of unfiltered jerk to the recordings' from which a body shakes; lively takes have 5 times
that of calm ones."""

FULL_CREDIT, NO_CREDIT = 1.25, 2.5
"""Ratio of two values up to which an aspect of likeness has the credit 1, and from which 0."""
FORWARD = 30.0
"""Percentage of windows that are nearest to motion played forwards, above which the credit is 1."""
SIDED = (30.0, 50.0)
"""Percentage of windows that are nearer to recordings than to mirrored ones, up to which the credit
is 0, and from which 1."""
LEAST_CREDIT = 0.05
"""Credit that an aspect counts at least, in a geometric mean."""
LEAST_OWN = 0.2
"""Score of the speaker's own takes below which likeness to them cannot be asked for."""
LEAST_SECONDS = 15.0
"""Seconds of a model's clips below which likeness cannot be asked for: of 10 s, a statue was about
as like the speaker as another take was."""
LIKE_SPREADS, LEAST_LIKE, LEAST_PARTLY_LIKE = 1.64, 0.7, 0.6
"""Likeness for yes: that of other takes of the speaker less this many of its standard deviations
(1 in 20 takes is below), and this value at least; for partly, at least."""
LEAST_IN_STYLE = 3
"""Recordings of each style of a speaker from which styles are compared one by one."""
SPEAKERS_DIFFER = 0.2
"""Difference of likeness between speakers from which they are named."""
NAMED_ASPECT = 0.6
"""Credit of an aspect, over the speaker's own, below which it is named."""
ENOUGH_SECONDS = 32.0
"""Seconds of generated motion from which patch metrics are informative."""
SATURATED = 0.99
"""CCA of one recording with another above which the metric cannot tell motions apart: clips with
few frames and many joints."""

COPIED, NEAR, OCCASIONALLY_COPIED = 0.5, 0.8, 0.6
"""Ratios to the distance of held-out recordings below which a model mostly copies, is nearer than
they are (medians), or copies occasionally (5 % quantile)."""
SAME = 0.002
"""Distance of recordings to training motion, metres, up to which they are training motion too: a
ratio to it says nothing."""

ALIKE = (0.8, 1.25)
"""Ratios of reach and fast gestures that count as equal."""
RESTS_ALIKE = (0.7, 1.4)
"""Ratios of the share of rests that count as equal."""
HARDLY_EVER = 0.35
"""Below this ratio of the share of rests, hands hardly ever rest."""
FEW_RESTS = 2.0
"""Percentage of rests in the recordings below which rests are not reported."""
FROZEN = 5.0
"""Hands count as frozen if they are nearly still in this many more percent of frames than the
recording's."""
MOTIONLESS = 90.0
"""Percentage of frames with nearly still hands above which the verdict reports nothing else."""
FOLLOWS = 0.4
"""Correlation of calm and lively stretches above which they count as those of the speaker."""
