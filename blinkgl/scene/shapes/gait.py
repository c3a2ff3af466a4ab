"""Motions of a figure: stand, walk, run, dance, wave, as joint angles over one round.

Pelvis and feet have prescribed positions, the legs follow by the law of cosines; the other joints have prescribed
angles. In ``walk`` and ``run`` a foot on the ground moves back, relative to the body, exactly as fast as the body moves
forward, first on its heel, then flat, then on its ball: it does not slide, except for what
:mod:`~blinkgl.scene.shapes.cycle` leaves out. Angles: about x (sideways), y (positive: a leg or an arm moves back, a
trunk leans forward), z; all zero is a body that stands with its arms down. x is forward, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.scene.shapes.cycle import Cycle

JOINTS = (
    "pelvis", "spine", "chest", "neck", "head",
    "clavicle_l", "arm_l", "forearm_l", "hand_l", "clavicle_r", "arm_r", "forearm_r", "hand_r",
    "thigh_l", "shank_l", "foot_l", "toes_l", "thigh_r", "shank_r", "foot_r", "toes_r",
)  # fmt: skip
J = {name: number for number, name in enumerate(JOINTS)}
# The index of each joint's parent in JOINTS; a parent comes before its children.
PARENTS = (-1, 0, 1, 2, 3, 2, 5, 6, 7, 2, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)
STEPS = 256
"""Number of phases at which a round is computed."""
_GRAVITY = 9.81
# The side's name, the sign of its y, and its delay in rounds: the right leg steps half a round after the left.
_SIDES = (("l", 1.0, 0.0), ("r", -1.0, 0.5))


@dataclass(frozen=True)
class Proportions:
    """Lengths of a body. height : m, from the soles to the crown.   build : thickness, 1: average.
    legs, arms, head : lengths relative to an average body's."""

    height: float = 1.75
    build: float = 1.0
    legs: float = 1.0
    arms: float = 1.0
    head: float = 1.0

    @cached_property
    def unit(self) -> float:
        """Return the factor on the lengths of an average body of 1.75 m."""
        # Lengths of an average body in m; together they are 1.75.
        trunk, leg, head = 0.045 + 0.10 + 0.16 + 0.24, 0.075 + 0.41 + 0.43, 0.08 + 0.21
        return self.height / (trunk + leg * self.legs + head * self.head)

    def __getattr__(self, name: str) -> float:
        try:
            length, part = _LENGTHS[name]
        except KeyError:
            raise AttributeError(name) from None
        return length * self.unit * (getattr(self, part) if part else 1.0)

    @property
    def hip(self) -> float:
        """Return the height of the hip joints above the ground, legs straight."""
        return self.ankle + self.shank + self.thigh

    @cached_property
    def offsets(self) -> np.ndarray:
        """Return each joint's position in its parent's frame, (21, 3); the pelvis above the ground, legs straight."""
        # x is forwards, y left, z up.
        out, u = np.zeros((len(JOINTS), 3)), self.unit
        out[J["pelvis"]] = [0, 0, self.hip + 0.045 * u]
        out[J["spine"]], out[J["chest"]], out[J["neck"]] = [0, 0, 0.10 * u], [0, 0, 0.16 * u], [-0.01 * u, 0, 0.24 * u]
        out[J["head"]] = [0.01 * u, 0, 0.08 * u * self.head]
        # Shoulders vary less than the build does.
        broad = 0.6 + 0.4 * self.build
        for side, sign, _ in _SIDES:
            out[J[f"clavicle_{side}"]] = [0, sign * 0.03 * u * broad, 0.19 * u]
            out[J[f"arm_{side}"]] = [0, sign * 0.155 * u * broad, -0.005 * u]
            out[J[f"forearm_{side}"]], out[J[f"hand_{side}"]] = [0, 0, -self.upper_arm], [0, 0, -self.forearm]
            out[J[f"thigh_{side}"]] = [0, sign * self.hip_half, -0.045 * u]
            out[J[f"shank_{side}"]], out[J[f"foot_{side}"]] = [0, 0, -self.thigh], [0, 0, -self.shank]
            out[J[f"toes_{side}"]] = [self.ball, 0, self.ball_height - self.ankle]
        return out


_LENGTHS = {
    "ankle": (0.075, "legs"), "shank": (0.41, "legs"), "thigh": (0.43, "legs"), "heel": (0.055, ""),
    "ball": (0.125, ""), "ball_height": (0.018, ""), "toes": (0.07, ""), "hip_half": (0.09, ""),
    "upper_arm": (0.29, "arms"), "forearm": (0.25, "arms"), "hand": (0.17, "arms"),
}  # fmt: skip


class _Pose:
    """A round under construction. angles : (N, 21, 3) rad.   pelvis : (N, 3) m in the body's frame."""

    def __init__(self, body: Proportions):
        self.body = body
        self.phi = np.arange(STEPS) / STEPS
        self.angles = np.zeros((STEPS, len(JOINTS), 3))
        self.pelvis = np.tile(self.body.offsets[0], (STEPS, 1))

    def wave(self, times: float = 1, late: float = 0.0) -> np.ndarray:
        """Return (N,) a cosine with ``times`` periods per round, with its maximum at the fraction ``late`` of a
        round."""
        return np.cos(2 * math.pi * times * (self.phi - late))

    def turn(self, sides: str = "lr", /, **degrees: tuple[float | np.ndarray, ...]) -> None:
        """Add degrees about x, y and z, numbers or (N,), to joints' angles. sides : of the limbs, "l" or "r"; or both,
        the right one's mirrored."""
        for joint, angles in degrees.items():
            for name in [joint] if joint in J else [f"{joint}_{side}" for side in sides]:
                # A mirror image reverses rotations about x and z; what is done on both sides has none about z.
                mirrored = sides == "lr" and name.endswith("_r")
                for axis, angle in enumerate(angles):
                    self.angles[:, J[name], axis] += np.radians(-angle if mirrored and axis == 0 else angle)

    def plant(self, feet: dict[str, tuple[np.ndarray, ...]], reach: float = 0.985) -> None:
        """Turn legs and feet so that the ankles are at their positions, the knees in front, and lower the pelvis by the
        same amount at all phases until the legs reach. feet : by side ((N, 3) ankle, (N,) pitch, (N,) yaw, (N,)
        toes)."""
        body = self.body
        # Joint 0 is the pelvis, whose rotation moves the hips.
        limit, turned = reach * (body.thigh + body.shank), Rotation.from_euler("XYZ", self.angles[:, 0])
        hips = {side: turned.apply(body.offsets[J[f"thigh_{side}"]]) for side in feet}
        # room: the greatest height of a hip from which a leg of length ``limit`` still reaches its ankle.
        room = [
            foot[0][:, 2] + np.sqrt(np.maximum(limit**2 - ((foot[0] - self.pelvis - hips[side])[:, :2] ** 2).sum(1), 0))
            for side, foot in feet.items()
        ]
        least = min(float((r - (self.pelvis + hips[side])[:, 2]).min()) for r, side in zip(room, feet))
        # Lowered by the same amount at all phases: lowering it for one foot would make the body bob.
        self.pelvis[:, 2] += min(least, 0.0)
        for side, (ankle, pitch, yaw, toes) in feet.items():
            # d: from hip to ankle in the pelvis's axes.
            d = turned.inv().apply(ankle - self.pelvis - hips[side])
            length = np.minimum(np.linalg.norm(d, axis=1), 0.9995 * (body.thigh + body.shank))
            # The law of cosines, for the outer angle of the knee: 0 is a straight leg.
            bent = (length**2 - body.thigh**2 - body.shank**2) / (2 * body.thigh * body.shank)
            knee = np.arccos(np.clip(bent, -0.9, 1))
            # lag: the angle between the thigh and the line from hip to ankle.
            lag = np.arctan2(body.shank * np.sin(knee), body.thigh + body.shank * np.cos(knee))
            angles = self.angles[:, J[f"thigh_{side}"]]
            # The angle about x puts the leg's plane through the ankle; the one about y turns the leg in that plane.
            angles[:, 0] = np.arctan2(d[:, 1], -d[:, 2])
            angles[:, 1] = np.arcsin(np.clip(-d[:, 0] / np.linalg.norm(d, axis=1), -1, 1)) - lag
            self.angles[:, J[f"shank_{side}"], 1] = knee
            leg = turned * Rotation.from_euler("XYZ", angles) * Rotation.from_euler("Y", knee[:, None])
            # The foot's pitch and yaw are given in the world, but its joint is attached to the leg.
            flat = Rotation.from_euler("ZY", np.stack([yaw, pitch], axis=1))
            self.angles[:, J[f"foot_{side}"]] = (leg.inv() * flat).as_euler("XYZ")
            self.angles[:, J[f"toes_{side}"], 1] = toes

    def cycle(self, period: float, phase: float, speed: float = 0.0) -> Cycle:
        return Cycle(self.body.offsets, self.angles, self.pelvis - self.body.offsets[0], period, phase, speed)


def _smooth(s: np.ndarray) -> np.ndarray:
    """Return a step from 0 to 1 with two zero derivatives at both ends."""
    s = np.clip(s, 0, 1)
    # The polynomial of degree 5 that is 0 and 1 at the ends, where two derivatives are 0.
    return s**3 * (10 - 15 * s + 6 * s**2)


def _between(s: np.ndarray, a: float, b: float, slope: float = 0.0) -> np.ndarray:
    """Return a curve from a to b, at both ends with this slope and no curvature."""
    return a + slope * s + (b - a - slope) * _smooth(s)


def _feet(pose: _Pose, stride: float, duty: float, strike: float, push: float, lift: float, apart: float) -> dict:
    """Return the feet of a moving body: each foot is on the ground for ``duty`` of the round, while it moves back by
    ``duty * stride``. strike, push : rad of the foot as it lands and leaves.   lift : m, of the ankle in between.
    apart : m from the middle."""
    body, feet = pose.body, {}
    foot = np.array([body.ball, body.ball_height - body.ankle]), np.array([-body.heel, -body.ankle])

    def at(s):
        """Return ((K, 2) ankle, (K,) pitch) on the ground, at s of ``duty``, 0 to 1."""
        # The foot lands with its toes up by ``strike``, is flat after a fifth, and rises on its ball in
        # the second half.
        down, up = -strike * (1 - _smooth(s / 0.2)), push * _smooth((s - 0.5) / 0.5)
        pitch = down + up
        ball, heel = (
            np.stack([np.cos(pitch) * o[0] + np.sin(pitch) * o[1], np.cos(pitch) * o[1] - np.sin(pitch) * o[0]], -1)
            for o in foot
        )
        # It rolls over the heel while its toes are up, and then over the ball.
        fixed = np.where((pitch < 0)[:, None], foot[1] - heel, foot[0] - ball)
        # 43 % of the way on the ground lies ahead of the body's origin.
        x = stride * duty * (0.43 - s) + fixed[:, 0]
        return np.stack([x, body.ankle + fixed[:, 1]], -1), pitch

    (first, last), (came, left) = at(np.array([0.0, 1.0]))
    for side, sign, late in _SIDES:
        phi = (pose.phi - late) % 1.0
        ground, s = phi < duty, (phi - duty) / (1 - duty)
        ankle, pitch = at(np.minimum(phi / duty, 1.0))
        # Both ends of the swing have the ground's speed, so that the foot lands and leaves smoothly.
        back = -stride * (1 - duty)
        swing = np.stack([_between(s, last[0], first[0], back), _between(s, last[1], first[1])], -1)
        early = np.clip(s, 0, 1) ** 0.75  # before the toes, which point down, come forward
        # 64 u^3 (1 - u)^3 is 1 in the middle, and two of its derivatives are 0 at the ends.
        swing[:, 1] += lift * 64 * (early * (1 - early)) ** 3
        turned = _between(s, left, came)
        ankle, pitch = np.where(ground[:, None], ankle, swing), np.where(ground, pitch, turned)
        toes = np.where(ground, -np.maximum(pitch, 0), -left * (1 - _smooth(s / 0.9)))
        place = np.stack([ankle[:, 0], np.full(STEPS, sign * apart), ankle[:, 1]], -1)
        feet[side] = place, pitch, np.zeros(STEPS), toes
    return feet


def _still_feet(pose: _Pose, apart: float, yaw: float = 0.2) -> dict:
    """Return two feet flat on the ground."""
    zero = np.zeros(STEPS)
    return {
        side: (np.tile([0.0, sign * apart, pose.body.ankle], (STEPS, 1)), zero, zero + sign * yaw, zero)
        for side, sign, _ in _SIDES
    }


def _round(body: Proportions, tempo: float, longest: float, stride: float, froude: float) -> tuple[float, float]:
    """Return (m of two steps, s for them) of a gait with steps of ``stride`` legs at tempo 1 and a speed of ``froude``
    sqrt(g leg). A higher tempo also lengthens the steps, up to ``longest`` times."""
    # Equal Froude numbers: legs of any length walk similarly (Alexander 1976).
    speed = froude * math.sqrt(_GRAVITY * body.hip)
    length = stride * body.hip
    return length * min(math.sqrt(tempo), longest), length / speed / tempo


def _walk(body: Proportions, tempo: float, phase: float, variant: int) -> Cycle:
    pose, u = _Pose(body), body.unit
    # The seed's second number is that of the motion, so motions of the same variant differ.
    rng = np.random.default_rng([variant, 1])
    sway, swing, lean = rng.uniform(0.8, 1.25, 3) if variant else np.ones(3)
    stride, period = _round(body, tempo, 1.2, 1.36, 0.43)
    pose.pelvis[:, 1] += 0.018 * u * sway * pose.wave(1, 0.3)
    pose.pelvis[:, 2] -= 0.02 * u * pose.wave(2, 0.04)
    yaw = -6 * pose.wave()
    pose.turn(
        pelvis=(3 * sway * pose.wave(1, 0.3), 0, yaw),
        spine=(-2 * sway * pose.wave(1, 0.3), 3 * lean, -0.8 * yaw),
        chest=(-2 * sway * pose.wave(1, 0.3), 1, -1.1 * yaw),
        neck=(0, -1, 0.5 * yaw),
        head=(0, -2.5 * lean + 0.8 * pose.wave(2, 0.1), 0.4 * yaw),
    )
    for side, sign, late in _SIDES:
        back = pose.wave(1, late - 0.02)
        pose.turn(
            side,
            clavicle=(0, 0, -sign * 3 * back),
            arm=(sign * 7, -2 + 24 * swing * back, 0),
            forearm=(0, -20 * swing + 13 * swing * back, 0),
            hand=(0, -6 + 4 * back),
        )
    # Each foot is down for 61 % of the round: above a half, so that both feet are down at times.
    pose.plant(_feet(pose, stride, 0.61, math.radians(18), math.radians(50), 0.045 * u, 0.05 * u), 0.996)
    # Cycle rounds its period to whole ns, and the speed fits the rounded one.
    return pose.cycle(period, phase, stride / (round(period * 1e9) * 1e-9))


def _run(body: Proportions, tempo: float, phase: float, variant: int) -> Cycle:
    pose, u = _Pose(body), body.unit
    rng = np.random.default_rng([variant, 2])
    swing, lean, high = rng.uniform(0.8, 1.2, 3) if variant else np.ones(3)
    stride, period = _round(body, tempo, 1.25, 2.2, 0.95)
    # Below a half, both feet are in the air at times.
    duty = 0.31
    pose.pelvis[:, 1] += 0.008 * u * pose.wave(1, duty / 2)
    # Lowest in the middle of each foot's time on the ground.
    pose.pelvis[:, 2] -= 0.035 * u * pose.wave(2, duty / 2)
    yaw = -9 * pose.wave(1, -0.05)
    pose.turn(
        pelvis=(2 * pose.wave(1, duty / 2), 4, yaw),
        spine=(0, 6 * lean, -0.9 * yaw),
        chest=(0, 3, -1.3 * yaw),
        neck=(0, -4, 0.6 * yaw),
        head=(0, -6 * lean + 1.5 * pose.wave(2, 0.1), 0.6 * yaw),
    )
    for side, sign, late in _SIDES:
        back = pose.wave(1, late - 0.06)
        pose.turn(
            side,
            clavicle=(0, 0, -sign * 5 * back),
            arm=(sign * 12, 6 + 38 * swing * back, 0),
            forearm=(sign * 8, -88 + 18 * back, 0),
        )
    feet = _feet(pose, stride, duty, math.radians(8), math.radians(48), 0.24 * u * high, 0.03 * u)
    pose.plant(feet, 0.985)
    return pose.cycle(period, phase, stride / (round(period * 1e9) * 1e-9))


def _stand(body: Proportions, tempo: float, phase: float, variant: int) -> Cycle:
    pose, u = _Pose(body), body.unit
    rng = np.random.default_rng([variant, 3])
    look, rest = rng.uniform(-14, 14, 2) if variant else np.zeros(2)
    pose.pelvis[:, 1] += 0.012 * u * pose.wave()
    pose.pelvis[:, 2] -= 0.004 * u * pose.wave(2)
    pose.turn(
        pelvis=(0.8 * pose.wave(), 0, rest / 3),
        spine=(-0.8 * pose.wave(), 0.6 * pose.wave(3)),
        chest=(0, -0.8 * pose.wave(3), 1.5 * pose.wave(1, 0.2)),
        head=(0, 1.5 * pose.wave(2, 0.3), look + 4 * pose.wave(1, 0.4)),
        clavicle=(-1.2 * pose.wave(3),),
        arm=(8 + 0.8 * pose.wave(3), 1 + 1.5 * pose.wave(1, 0.1)),
        forearm=(0, -12 + 1.5 * pose.wave(2)),
    )
    pose.plant(_still_feet(pose, 0.1 * u))
    return pose.cycle(4.0 / tempo, phase)


def _wave(body: Proportions, tempo: float, phase: float, variant: int) -> Cycle:
    """Return four swings of a hand; every second variant uses the left one."""
    pose, u = _Pose(body), body.unit
    rng = np.random.default_rng([variant, 4])
    # Variants differ in size and in the hand that waves.
    wide, high = rng.uniform(0.8, 1.2, 2) if variant else np.ones(2)
    side, sign = ("l", 1.0) if variant % 2 else ("r", -1.0)
    other = "r" if side == "l" else "l"
    # Four waves of the hand in a round; the trunk gives way to the arm's weight.
    to = pose.wave(4)
    pose.pelvis[:, 1] -= sign * (0.015 + 0.006 * pose.wave()) * u
    pose.turn(
        side,
        pelvis=(-1.5 * sign,),
        spine=(-2 * sign + 0.6 * to,),
        chest=(-2 * sign + 0.8 * to, 0, 4 * sign),
        head=(-4 * sign - 1.2 * to, 2 * pose.wave(1, 0.2), 4 * pose.wave(1, 0.6)),
        clavicle=(14 * sign + 1.5 * sign * to,),
        arm=(sign * (100 * high + 5 * wide * to), -14),
        forearm=(sign * (58 - 26 * wide * pose.wave(4, 0.02)), -8),
        hand=(-sign * 16 * wide * pose.wave(4, 0.07),),
    )
    pose.turn(other, arm=(-sign * 9, 3 + 2 * pose.wave()), forearm=(0, -16))
    # Feet stay where they are: the legs follow the pelvis by inverse kinematics.
    pose.plant(_still_feet(pose, 0.11 * u))
    return pose.cycle(3.0 / tempo, phase)


def _dance(body: Proportions, tempo: float, phase: float, variant: int) -> Cycle:
    """Return a dance of four beats per round, 116 per minute: steps, hips and arms depend on the variant."""
    pose, u = _Pose(body), body.unit
    rng = np.random.default_rng([variant, 5])
    big, loose, late = rng.uniform(0.8, 1.2), rng.uniform(0.7, 1.3), rng.uniform(-0.03, 0.03)
    step, arms = int(rng.integers(4)), int(rng.integers(5))
    # Four beats and two steps to the side in a round, at 116 beats a minute.
    beat = pose.wave(4, late)
    side = pose.wave(2, 0.125 + late)
    apart = 0.15 * u
    pose.pelvis[:, 2] -= (0.045 + 0.022 * big * (1 + beat)) * u
    pose.pelvis[:, 1] += 0.045 * u * big * side
    pose.turn(
        pelvis=(-7 * loose * side, 3 * pose.wave(4, 0.1)),
        spine=(8 * loose * side, 4 + 2 * beat),
        chest=(5 * loose * pose.wave(2, 0.2 + late), -3 * pose.wave(4, 0.05)),
        neck=(-3 * side, 3 * beat),
        head=(-5 * loose * pose.wave(2, 0.18), 5 * pose.wave(4, 0.03), 10 * pose.wave(1, 0.2)),
    )
    feet = _still_feet(pose, apart, 0.25)
    _dance_step(pose, feet, step, big)
    _dance_arms(pose, arms, loose, side, beat)
    pose.plant(feet, 0.975)
    return pose.cycle(4 * 60 / 116 / tempo, phase)


def _dance_step(pose: _Pose, feet: dict, step: int, big: float) -> None:
    """Add one of four steps. big : size of the movement, 1 on average."""
    u = pose.body.unit
    if step == 0:  # heels rise with the beat, knees move in and out
        _tap(pose, feet, pitch=24, per_round=2)
    elif step == 1:  # from side to side
        shift = 0.13 * u * big * pose.wave(1, 0.25)
        pose.pelvis[:, 1] += 0.9 * shift
        for name, sign, _ in _SIDES:
            ankle, pitch, yaw, toes = feet[name]
            # One foot moves quickly while the other carries, then rests.
            slow = np.sin(2 * math.pi * pose.phi) + sign * 0.25 * np.cos(4 * math.pi * pose.phi)
            ankle[:, 1] += 0.13 * u * big * np.tanh(2.2 * slow) / np.tanh(2.2)
            moving = (1 - np.tanh(2.2 * slow) ** 2) ** 2
            ankle[:, 2] += 0.06 * u * moving
            feet[name] = ankle, pitch + 0.15 * moving, yaw, toes
    elif step == 2:  # the twist
        turn = 24 * big * pose.wave(2, 0.03)
        pose.turn(pelvis=(0, 0, turn), spine=(0, 0, -0.9 * turn), chest=(0, 0, -0.7 * turn), head=(0, 0, 0.6 * turn))
        _tap(pose, feet, pitch=14, per_round=2)
        for name in feet:
            ankle, pitch, yaw, toes = feet[name]
            feet[name] = ankle, pitch, yaw + np.radians(0.8 * turn), toes
    else:  # marching in place, knees up
        for name, _, first in _SIDES:
            ankle, pitch, yaw, toes = feet[name]
            up = np.maximum(np.sin(2 * math.pi * (2 * pose.phi - first - 0.05)), 0) ** 2
            ankle[:, 2] += 0.17 * u * big * up
            ankle[:, 0] += 0.05 * u * up
            feet[name] = ankle, pitch + 0.5 * up, yaw, toes


def _dance_arms(pose: _Pose, arms: int, loose: float, side: np.ndarray, beat: np.ndarray) -> None:
    """Add one of five arm movements. loose : amplitude, 1 on average.   side, beat : (N,) waves."""
    if arms == 0:  # both up, swaying
        for name, sign, _ in _SIDES:
            arm, forearm = (sign * 138 + 14 * side, -12), (sign * 18 + 14 * side, -18 + 10 * beat)
            pose.turn(name, clavicle=(sign * 16,), arm=arm, forearm=forearm)
    elif arms == 1:  # pumping before the chest
        for name, sign, first in _SIDES:
            pump = pose.wave(2, 0.5 * first + 0.05)
            pose.turn(name, arm=(sign * 24, -26 - 26 * loose * pump), forearm=(sign * 14, -95 + 22 * pump))
    elif arms == 2:  # one hand points up and down diagonally, the other on the hip
        up = 0.5 + 0.5 * np.tanh(2 * pose.wave(2, 0.1)) / np.tanh(2)
        pose.turn("r", clavicle=(-14 * up,), arm=(-30 - 112 * up, -30 + 16 * up), forearm=(-4, -35 * (1 - up) - 8))
        pose.turn("l", arm=(42, 22), forearm=(-48, -78))
    elif arms == 3:  # rolling forearms
        for name, sign, first in _SIDES:
            pose.turn(
                name,
                arm=(sign * (18 + 8 * pose.wave(4, 0.5 * first)), -48 + 14 * pose.wave(4, 0.25 * first)),
                forearm=(-sign * 30, -80 + 26 * pose.wave(4, 0.125 * first + 0.06), -sign * 10),
            )
    else:  # a wave from one hand to the other
        for name, sign, _ in _SIDES:
            run = 0.06 * sign
            pose.turn(
                name,
                clavicle=(sign * (6 + 6 * pose.wave(2, 0.02 - run)),),
                arm=(sign * (78 + 22 * loose * pose.wave(2, -run)), -8),
                forearm=(sign * 24 * pose.wave(2, 0.06 - run), -14),
                hand=(sign * 30 * pose.wave(2, 0.12 - run),),
            )


def _tap(pose: _Pose, feet: dict, pitch: float, per_round: int) -> None:
    """Lift the heels in turn; the balls stay on the ground."""
    body = pose.body
    for name, _, late in _SIDES:
        ankle, _, yaw, _ = feet[name]
        turned = math.radians(pitch) * (0.5 + 0.5 * pose.wave(per_round, late / per_round)) ** 2
        ball = np.array([body.ball, body.ball_height - body.ankle])
        # The ball stays where it is: the ankle moves by as much as the rotation would move the ball.
        x = ball[0] - (np.cos(turned) * ball[0] + np.sin(turned) * ball[1])
        ankle[:, :2] += x[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
        ankle[:, 2] += ball[1] - (np.cos(turned) * ball[1] - np.sin(turned) * ball[0])
        feet[name] = ankle, turned, yaw, -turned


CLIPS: dict[str, Callable[[Proportions, float, float, int], Cycle]] = {
    "stand": _stand,
    "walk": _walk,
    "run": _run,
    "dance": _dance,
    "wave": _wave,
}


def clip_of(name: str, body: Proportions, tempo: float = 1.0, phase: float = 0.0, variant: int = 0) -> Cycle:
    """Return a motion. name : of CLIPS.   tempo : 1: natural at the body's size.   phase : rounds at time 0.
    variant : which dance, or style of walking; 0 is the plain one."""
    return CLIPS[name](body, tempo, phase, variant)
