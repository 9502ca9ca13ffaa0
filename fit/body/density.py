"""Between litres and kilograms: the density of a standing body as a surface encloses it, lung air included.

Tissue is fat and the rest (Siri 1961: 0.900 and 1.100 kg/l). How much of it is fat follows from the body-mass
index (Deurenberg, Weststrate & Seidell 1991) at the survey's middle age; the air is what is left in the lungs
after a quiet breath (functional residual capacity, Quanjer et al. 1993). Men come out near 1.01 kg/l, women
near 0.99, and heavy people a little lower. The spread between persons of one build (about 1 %) is not
modelled.
"""

import numpy as np

AGE_YEARS = 30.0
FAT_KG_PER_LITRE, LEAN_KG_PER_LITRE = 0.900, 1.100
FAT_RANGE = (0.05, 0.55)  # of body mass: nobody lives outside it, though the regression would go there


def fat_share(bmi: float, sex: float) -> float:
    """Share of body mass that is fat; `sex` from 0 (female) to 1 (male)."""
    percent = 1.20 * bmi + 0.23 * AGE_YEARS - 10.8 * sex - 5.4
    return float(np.clip(percent / 100, *FAT_RANGE))


def lung_litres(stature: float, sex: float) -> float:
    """Air in the lungs after a quiet breath (litres), for a stature in metres."""
    female = 2.24 * stature + 0.001 * AGE_YEARS - 1.00
    male = 2.34 * stature + 0.01 * AGE_YEARS - 1.09
    return female + (male - female) * sex


def volume_litres(weight: float, stature: float, sex: float) -> float:
    """What the skin of a person of this weight (kg) and stature (m) encloses, litres."""
    fat = fat_share(weight / stature**2, sex)
    return weight * (fat / FAT_KG_PER_LITRE + (1 - fat) / LEAN_KG_PER_LITRE) + lung_litres(stature, sex)


def weight_kg(litres: float, stature: float, sex: float) -> float:
    """The weight (kg) of a person whose skin encloses so many litres: the inverse of `volume_litres`."""
    low, high = 0.3 * litres, 1.2 * litres
    for _ in range(60):  # volume grows with weight everywhere, so halving finds it
        middle = 0.5 * (low + high)
        low, high = (middle, high) if volume_litres(middle, stature, sex) < litres else (low, middle)
    return 0.5 * (low + high)
