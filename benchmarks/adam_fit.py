"""The peer of the fit's solver: a template registered by Adam, as SMPL+D registrations are done.

The same energy to the letter (`Objective` of the alignment's last stage) is minimised by Adam on gradients
from JAX over pose, translation, betas and free offsets D of every vertex, T = M(betas) + D: first pose and
shape alone, then all. Closest points come from the same search as the solver's and are refreshed every step
or every few, which is where such tools spend their time. One step is compiled once; compiling is not counted,
nor is the evaluation of the exact energy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fit.closest import ClosestPoints
from fit.solver import Objective
from fit.state import BodyState

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class AdamRates:
    """Learning rates: pose (rad), translation (m) and betas (deviations) share one scale; offsets (m);
    refresh: steps between searches; pose_steps: before the offsets join; half_life: steps in which the rates
    halve from then on, 0: they stay."""

    parameters: float
    offsets: float
    refresh: int = 1
    pose_steps: int = 60
    half_life: int = 0

    @property
    def text(self) -> str:
        halved = f", halved every {self.half_life}" if self.half_life else ""
        return f"{self.parameters:g} / {self.offsets:g}{halved}, closest points every {self.refresh}"


@dataclass(frozen=True)
class AdamRun:
    """Processor seconds and exact energy at checkpoints, steps at the last."""

    seconds: tuple[float, ...]
    energies: tuple[float, ...]
    steps: int

    def seconds_to(self, energy: float) -> float:
        """When the energy was first reached; infinite if it never was."""
        reached = [s for s, e in zip(self.seconds, self.energies, strict=True) if e <= energy]
        return reached[0] if reached else float("inf")


class AdamPeer:
    """One objective (skin on all points), ready for many runs."""

    def __init__(self, objective: Objective) -> None:
        import jax
        import jax.numpy as jnp

        from fit.body.skinning import SkinningArrays, skin

        assert not objective.weights.cloth, "the peer knows the alignment's energy only"
        fitter, w = objective.fitter, objective.weights
        self.objective = objective
        arrays = SkinningArrays.of(fitter.model.with_betas(0))
        template = jnp.asarray(fitter.model.template)
        directions = jnp.asarray(fitter.model.shape_directions)
        joint_rest, joint_shape = jnp.asarray(fitter.shape.joint_rest), jnp.asarray(fitter.shape.joint_shape)
        points = jnp.asarray(objective.scan.points)
        edges, strength = jnp.asarray(fitter.mesh.edges), jnp.asarray(fitter.mesh.strength)
        mean, precision = jnp.asarray(objective.pose_mean), jnp.asarray(objective.pose_precision)

        def energy(x: dict[str, Any], corners: Any, barycentric: Any, scale: Any) -> Any:
            shaped = template + directions @ x["betas"]
            joints = joint_rest + joint_shape @ x["betas"]
            vertices = skin(arrays, shaped + x["offsets"], joints, x["pose"], x["translation"])
            foot = (barycentric[:, :, None] * vertices[corners]).sum(1)
            squared = ((points - foot) ** 2).sum(1)
            data = (scale * w.sigma_m**2 * squared / (w.sigma_m**2 + squared)).sum()
            stretch = x["offsets"][edges[:, 0]] - x["offsets"][edges[:, 1]]
            away = x["pose"][1:].ravel() - mean
            return (
                data
                + w.coupling * (strength[:, None] * stretch**2).sum()
                + w.tether * (x["offsets"] ** 2).sum()
                + w.pose_prior * away @ precision @ away
                + w.shape_prior * (x["betas"] ** 2).sum()
            )

        def step(
            x: dict[str, Any], first: Any, second: Any, t: Any, rates: Any, *data: Any
        ) -> tuple[Any, Any, Any, Any]:
            value, gradient = jax.value_and_grad(energy)(x, *data)
            first = jax.tree.map(lambda m, g: BETA_1 * m + (1 - BETA_1) * g, first, gradient)
            second = jax.tree.map(lambda v, g: BETA_2 * v + (1 - BETA_2) * g * g, second, gradient)
            x = jax.tree.map(
                lambda a, m, v, rate: (
                    a - rate * (m / (1 - BETA_1**t)) / (jnp.sqrt(v / (1 - BETA_2**t)) + EPSILON)
                ),
                x,
                first,
                second,
                rates,
            )
            return x, first, second, value

        def vertices_of(x: dict[str, Any]) -> Any:
            shaped = template + directions @ x["betas"]
            joints = joint_rest + joint_shape @ x["betas"]
            return skin(arrays, shaped + x["offsets"], joints, x["pose"], x["translation"])

        self._step: Callable[..., Any] = jax.jit(step)
        self._vertices: Callable[..., Any] = jax.jit(vertices_of)
        self._value: Callable[..., Any] = jax.jit(energy)

    def _unknowns(self, state: BodyState) -> dict[str, Any]:
        import jax.numpy as jnp

        shaped = self.objective.fitter.shaped(state.betas)
        return {
            "pose": jnp.asarray(state.pose),
            "translation": jnp.asarray(state.translation),
            "betas": jnp.asarray(state.betas),
            "offsets": jnp.asarray(state.template - shaped),
        }

    def state(self, x: dict[str, Any]) -> BodyState:
        """The unknowns as the solver has them."""
        betas = np.asarray(x["betas"])
        template = self.objective.fitter.shaped(betas) + np.asarray(x["offsets"])
        return BodyState(template, np.asarray(x["pose"]), np.asarray(x["translation"]), betas)

    def _data(self, x: dict[str, Any], guess: np.ndarray | None) -> tuple[Any, ...]:
        """What a search gives: corners, barycentric weights, weights of the points; and the triangles."""
        objective = self.objective
        closest: ClosestPoints = objective.fitter.surface.closest(
            np.asarray(self._vertices(x)), objective.scan.points, guess
        )
        facing = (objective.scan.normals * closest.normals).sum(1)
        scale = np.clip((facing + 0.2) / 0.6, 0.0, 1.0) if objective.weights.gate else np.ones(len(facing))
        scale = scale * objective.scan.weight * len(objective.fitter.model.template) / len(facing)
        corners = objective.fitter.model.faces[closest.triangle_idx]
        return (corners, closest.barycentric, scale), closest.triangle_idx

    def value(self, state: BodyState) -> float:
        """The peer's own energy of a state: the same as the solver's."""
        x = self._unknowns(state)
        return float(self._value(x, *self._data(x, None)[0]))

    def run(
        self, start: BodyState, rates: AdamRates, most_seconds: float, good_enough: float, every: int = 20
    ) -> AdamRun:
        """Minimise until the energy is reached or the processor time is spent."""
        import jax
        import jax.numpy as jnp

        x = self._unknowns(start)
        zero = jax.tree.map(jnp.zeros_like, x)
        first, second = zero, zero
        p = rates.parameters
        scales = {"pose": p, "translation": p, "betas": 3.0 * p, "offsets": 0.0}
        data, guess = self._data(x, None)
        self._step(x, first, second, 1.0, scales, *data)  # compile
        seconds, energies = [0.0], [self.objective.energy(self.state(x))]
        spent, begun, t = 0.0, time.process_time(), 0
        while spent < most_seconds:
            if t == rates.pose_steps:
                scales = {**scales, "offsets": rates.offsets}
            if rates.half_life and t > rates.pose_steps:
                scales = {name: rate * 0.5 ** (1.0 / rates.half_life) for name, rate in scales.items()}
            if t % rates.refresh == 0:
                data, guess = self._data(x, guess)
            t += 1
            x, first, second, value = self._step(x, first, second, float(t), scales, *data)
            value.block_until_ready()
            if t % every == 0:
                spent += time.process_time() - begun
                seconds.append(spent)
                energies.append(self.objective.energy(self.state(x)))
                if energies[-1] <= good_enough:
                    break
                begun = time.process_time()
        return AdamRun(tuple(seconds), tuple(energies), t)
