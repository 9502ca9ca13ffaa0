"""People drawn from the measured covariance of body measures: the generator's first step.

The statistics are those of ANSUR II, the 2012 survey of U.S. Army personnel (Gordon et al. 2014,
NATICK/TR-15/007, public release; 4082 men, 1986 women), reduced to the measures needed here and kept in
`ansur2.json`. Each sex is one Gaussian in the logarithms of its measures: girths and lengths multiply, never
turn negative, and the body-mass index is a plain linear function (log weight - 2 log stature).

Soldiers are heavier-muscled and span less body mass than the public, so the BMI is replaced by a civilian one
(CIVILIAN_BMI, from 16 to 45) and every other measure follows along its regression on the BMI; what is left of
a measure at a given BMI keeps its measured covariance. Two measures the survey lacks (breast size, muscle
definition beyond girths) are free factors.
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from jaxtyping import Float

BMI_RANGE = (16.0, 45.0)
"""kg/m2: nobody is drawn outside it."""
CIVILIAN_BMI = {"female": (24.3, 0.205), "male": (25.8, 0.175)}
"""Median (kg/m2) and standard deviation of the logarithm. Assumed figures, not taken from a table; for
comparison, the median of U.S. adults in NHANES III (1988-1994) was 25.5 (Kuczmarski et al. 1997)."""
MAX_SCORE = 2.5
"""Scores are clipped here: beyond it the primitives of the anatomy begin to interpenetrate."""
FREE_FACTORS = ("bust", "definition")

# Measures of the survey that are not taken at the place (or in the state) the anatomy wants, with the factor
# between the two. Flexed arm girths shrink at rest; the lower thigh is taken above the knee. The factors are
# ours: each makes the survey's average agree with the average that the station tables were modelled on.
KNEE_FROM_LOWER_THIGH = 0.94
RESTING_FROM_FLEXED_BICEPS = 0.94
RESTING_FROM_FLEXED_FOREARM = 0.97
HEAD_HEIGHT_FROM_PARTS = 0.912  # chin to crown, from (tragion to crown) + (chin to sellion)
UPPER_ARM_FROM_ACROMION_RADIALE = 0.838  # joint centre to joint centre
FOREARM_FROM_RADIALE_STYLION = 0.975
CHEST_WITH_ARMS_RAISED = 1.12  # the latissimus spreads when the arms are held out
ACROMION_BELOW_CHIN_M, CERVICALE_BELOW_CHIN_M = 0.048, -0.006
"""At least so much of the neck is free: a stooped person's chin lies lower, but ours hold the head up."""
NECK_ROOM_BLEND_M = 0.012
MOST_BUST = 2.6
"""Beyond it the template has too few vertices on the breast for a smooth one."""


@dataclass(frozen=True)
class Measurements:
    """One person, in metres (BMI: kg/m2). `sex` runs from 0 (female) to 1 (male) and may lie between."""

    sex: float
    stature: float
    bmi: float
    neck: float  # girths
    chest: float
    waist: float
    hip: float
    thigh: float
    knee: float
    calf: float
    ankle: float
    biceps: float
    forearm: float
    wrist: float
    head_height: float  # lengths and breadths
    head_length: float
    head_breadth: float
    biacromial: float
    hand_length: float
    hand_breadth: float
    foot_length: float
    foot_breadth: float
    upper_arm: float
    lower_arm: float
    knee_height: float  # heights above the floor
    crotch_height: float
    navel_height: float
    acromion_height: float
    cervicale_height: float
    chest_breadth: float  # breadths and depths of the trunk where its girths are
    chest_depth: float
    waist_breadth: float
    waist_depth: float
    hip_breadth: float
    hip_depth: float
    fat: float  # log of BMI over the survey's mean BMI of this sex
    muscle: float  # factors: 1 is usual (midway between the sexes for muscle)
    bust: float
    fullness: float = 0.0
    """Log of how much fuller the sections between the measured girths are than usual."""
    waist_squareness: float = 0.0
    """Log of how much the exponents of the trunk's sections exceed the usual: 2 is an ellipse, more a box."""
    hip_squareness: float = 0.0

    @property
    def weight(self) -> float:
        """Body mass in kilograms."""
        return self.bmi * self.stature**2


TRUNK_SECTIONS = ("chest", "waist", "hip")
SQUARED_SECTIONS = ("waist", "hip")
"""The chest is not among them: its outline is that of shoulder blades, breast and armpits."""
GIRTHS = ("neck", "chest", "waist", "hip", "thigh", "knee", "calf", "ankle", "biceps", "forearm", "wrist")


@dataclass(frozen=True)
class SexStatistics:
    """One sex's Gaussian in the logarithms of its measures (survey units: millimetres, kilograms)."""

    measures: tuple[str, ...]
    mean_log: Float[np.ndarray, "m"]
    root_log: Float[np.ndarray, "m m"]  # lower-triangular square root of the covariance
    log_bmi: Float[np.ndarray, "m"]  # the linear functional that reads log BMI (kg/m2) off, up to a constant
    civilian_mean: float
    civilian_sd: float

    @property
    def covariance(self) -> Float[np.ndarray, "m m"]:
        return self.root_log @ self.root_log.T


MM_BMI_OFFSET = 2 * np.log(1000.0)  # statures are in millimetres in the survey


@cache
def load_statistics(sex_name: str) -> SexStatistics:
    """The shipped table of one sex ('female' or 'male')."""
    table = json.loads(resources.files(__package__).joinpath("ansur2.json").read_text(encoding="utf-8"))
    measures = tuple(table["measures"])
    own = table[sex_name]
    mean, sd = np.array(own["mean"]), np.array(own["sd"])
    variation = sd / mean
    # A log-normal variable of this mean and coefficient of variation; correlations hardly change for CV <
    # 0.2.
    log_sd = np.sqrt(np.log1p(variation**2))
    covariance = np.array(own["correlation"]) * np.outer(log_sd, log_sd)
    covariance += 1e-9 * np.eye(len(mean))  # the table is rounded to four decimals
    functional = np.zeros(len(mean))
    functional[measures.index("weightkg")] = 1.0
    functional[measures.index("stature")] = -2.0
    median, civilian_sd = CIVILIAN_BMI[sex_name]
    return SexStatistics(
        measures=measures,
        mean_log=np.log(mean) - 0.5 * log_sd**2,
        root_log=np.linalg.cholesky(covariance),
        log_bmi=functional,
        civilian_mean=float(np.log(median)),
        civilian_sd=civilian_sd,
    )


def n_scores() -> int:
    """How many standard-normal scores describe one person (besides the sex)."""
    return len(load_statistics("female").measures) + len(FREE_FACTORS)


def mix(female_male: tuple[float, float], sex: float) -> float:
    """Value between the sexes; extrapolates mildly for `sex` outside [0, 1]."""
    female, male = female_male
    return female + (male - female) * sex


def measure(
    sex: float, scores: Float[np.ndarray, "s"] | None = None, *, bmi: float | None = None
) -> Measurements:
    """The person of these independent standard-normal scores (all zero: the average one of this `sex`).

    Between the sexes the means and the square roots of the covariances are mixed. `bmi`, when given, replaces
    the drawn body-mass index, and the other measures follow their regression on it.
    """
    z = np.zeros(n_scores()) if scores is None else np.asarray(scores, dtype=np.float64)
    female, male = load_statistics("female"), load_statistics("male")
    root = female.root_log + (male.root_log - female.root_log) * sex
    mean = female.mean_log + (male.mean_log - female.mean_log) * sex
    covariance = root @ root.T
    functional = female.log_bmi
    n_measures = len(mean)
    deviation = root @ z[:n_measures]

    # Replace the soldier's BMI by the civilian of the same rank.
    slope = covariance @ functional / (functional @ covariance @ functional)
    survey_log_bmi = float(functional @ mean) + MM_BMI_OFFSET
    rank = float(functional @ deviation) / float(np.sqrt(functional @ covariance @ functional))
    if bmi is None:
        log_bmi = mix((female.civilian_mean, male.civilian_mean), sex) + rank * mix(
            (female.civilian_sd, male.civilian_sd), sex
        )
        log_bmi = float(np.clip(log_bmi, *np.log(BMI_RANGE)))
    else:
        log_bmi = float(np.log(bmi))
    deviation = deviation + slope * (log_bmi - survey_log_bmi - float(functional @ deviation))

    # What stature and BMI leave unexplained: proportions within a build.
    stature_axis = np.zeros(n_measures)
    stature_axis[female.measures.index("stature")] = 1.0
    readings = np.stack([stature_axis, functional])
    expected = (
        covariance @ readings.T @ np.linalg.solve(readings @ covariance @ readings.T, readings @ deviation)
    )
    residual = dict(zip(female.measures, (deviation - expected).tolist(), strict=True))
    value = dict(zip(female.measures, (np.exp(mean + deviation) / 1000.0).tolist(), strict=True))

    bust_score, definition_score = z[n_measures:]
    fat = log_bmi - survey_log_bmi
    arm_over_belly = residual["bicepscircumferenceflexed"] + residual["forearmcircumferenceflexed"]
    muscle_score = 12.0 * (arm_over_belly - 0.5 * residual["waistcircumference"]) + 0.6 * definition_score
    breast = max(0.0, 1.0 - sex) * np.exp(0.35 * bust_score + 0.9 * fat)
    chest_of_men = 0.06 * float(np.clip(sex, 0, 1)) * np.exp(3 * fat)  # only fat builds one
    head_height = (value["tragiontopofhead"] + value["mentonsellionlength"]) * HEAD_HEIGHT_FROM_PARTS
    chin = value["stature"] - head_height
    return Measurements(
        sex=float(sex),
        stature=value["stature"],
        bmi=float(np.exp(log_bmi)),
        neck=value["neckcircumference"],
        chest=value["chestcircumference"],
        waist=value["waistcircumference"],
        hip=value["buttockcircumference"],
        thigh=value["thighcircumference"],
        knee=value["lowerthighcircumference"] * KNEE_FROM_LOWER_THIGH,
        calf=value["calfcircumference"],
        ankle=value["anklecircumference"],
        biceps=value["bicepscircumferenceflexed"] * RESTING_FROM_FLEXED_BICEPS,
        forearm=value["forearmcircumferenceflexed"] * RESTING_FROM_FLEXED_FOREARM,
        wrist=value["wristcircumference"],
        head_height=head_height,
        head_length=value["headlength"],
        head_breadth=value["headbreadth"],
        biacromial=value["biacromialbreadth"],
        hand_length=value["handlength"],
        hand_breadth=value["handbreadth"],
        foot_length=value["footlength"],
        foot_breadth=value["footbreadthhorizontal"],
        upper_arm=value["acromionradialelength"] * UPPER_ARM_FROM_ACROMION_RADIALE,
        lower_arm=value["radialestylionlength"] * FOREARM_FROM_RADIALE_STYLION,
        knee_height=value["kneeheightmidpatella"],
        crotch_height=value["crotchheight"],
        navel_height=value["waistheightomphalion"],
        acromion_height=_at_most(value["acromialheight"], chin - ACROMION_BELOW_CHIN_M, NECK_ROOM_BLEND_M),
        cervicale_height=_at_most(value["cervicaleheight"], chin - CERVICALE_BELOW_CHIN_M, NECK_ROOM_BLEND_M),
        fat=fat,
        chest_breadth=value["chestbreadth"] * CHEST_WITH_ARMS_RAISED,
        chest_depth=value["chestdepth"],
        waist_breadth=value["waistbreadth"],
        waist_depth=value["waistdepth"],
        hip_breadth=value["hipbreadth"],
        hip_depth=value["buttockdepth"],
        muscle=float(np.exp(0.35 * np.clip(muscle_score, -2.5, 2.5) + 0.35 * (sex - 0.5))),
        bust=_at_most(float(breast + chest_of_men), MOST_BUST, MOST_BUST / 5),
    )


def _at_most(value: float, most: float, blend: float) -> float:
    """The smaller of the two, without a corner where they are within `blend` of each other."""
    near = max(blend - abs(value - most), 0.0) / blend
    return min(value, most) - 0.25 * near * near * blend


@cache
def survey_mean(sex: float) -> Measurements:
    """The survey's average person of this sex at the survey's own BMI: what the station tables describe."""
    female, male = load_statistics("female"), load_statistics("male")
    bmis = [float(np.exp(s.log_bmi @ s.mean_log + MM_BMI_OFFSET)) for s in (female, male)]
    return measure(sex, bmi=float(np.exp(mix((np.log(bmis[0]), np.log(bmis[1])), sex))))


def draw_people(
    n: int, seed: int, sex: float | None
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n s"]]:
    """Sexes and scores of n people, in antithetic pairs (z, -z), so that the sample's mean is exact.

    `sex` None alternates women and men (pairs of one of each); the coordinate is jittered a little either
    way.
    """
    rng = np.random.default_rng(seed)
    sexes, scores = np.empty(n + n % 2), np.empty((n + n % 2, n_scores()))
    for pair_idx in range(len(sexes) // 2):
        z = np.clip(rng.standard_normal(n_scores()), -MAX_SCORE, MAX_SCORE)
        jitter = float(np.clip(rng.normal(0, 0.10), -0.2, 0.2))
        first = float(pair_idx % 2) if sex is None else sex
        second = 1.0 - first if sex is None else sex
        sexes[2 * pair_idx : 2 * pair_idx + 2] = first + jitter, second - jitter
        scores[2 * pair_idx : 2 * pair_idx + 2] = z, -z
    return sexes[:n], scores[:n]
