"""The tool that hangs on a wrist sensor, and the force that it exerts once its own share is removed.

With F the sensor's reading, R the rotation from the tool's axes to the world's, a and v the acceleration and
velocity of the tool, g gravity and f the force of the tool on its environment in the tool's axes,

    F = b + Q (m_a R^T (a + tau da/dt) - m R^T g + d R^T v + f),

where b is the sensor's offset, m the tool's mass, d the drag of cables and hoses, Q the axes of the sensor,
with det Q = -1 if it reads the reaction. m_a is m for a rigid tool; gears that spin with the arm make it
appear larger, so it is fitted separately. In free motion f = 0, and the regression of F on the motion gives
all of them (robust least squares; Q by Kabsch's 1976 solution of the orthogonal Procrustes problem). Where
the pose lags behind the wrench, or leads, F is compared with the motion whole samples later, or earlier, and
tau is what is left of this delay. An arm that never turns its hand shows only the sum of b and the tool's
weight, which suffices, as the weight is then constant.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.rig import AXES, Gripper, Rig, direction
from hmmseg.io.trial import Trial
from hmmseg.levels import SURE, TAIL, decisive
from hmmseg.robust import bridged, robust_sd, white_sd

WINDOW, WIDEST = 0.1, 0.4  # chosen: s over which motion is smoothed: arms change no faster
LEAST = 3  # numerics: samples in the window: what a parabola needs
QUIET = 0.1  # chosen: m/s^2 (a hundredth of gravity); the window widens until acceleration is less noisy


@dataclass(frozen=True)
class Pose:
    """Motion of the midpoint of the pads, in the world, at t (num_timesteps,) [s].

    Attributes:
        position, velocity, acceleration: (num_timesteps, 3) [m, m/s, m/s^2], the latter two smoothed.
        turned: (num_timesteps, 3, 3) rotation from the tool's axes to the world's.
        up, across: (3,) unit vectors against gravity, and horizontally along the closing.
        window: [s] of the smoothing.
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    turned: np.ndarray
    up: np.ndarray
    across: np.ndarray
    window: float


def pose_of(trial: Trial, gripper: Gripper, window: float | None = None) -> Pose:
    """Pose at every sample, with gaps bridged; InputError if it cannot be determined.

    `window` [s] of the smoothing; by default as wide as the noise requires.
    """
    t, n = trial.t, trial.t.size
    position = np.zeros((n, 3))
    for axis, name in gripper.position.items():
        position[:, AXES.index(axis)] = bridged(trial.channels[name], t)
    turned = _turned(trial, gripper)
    position = position + np.einsum("tij,j->ti", turned, np.asarray(gripper.fingertip))
    up = direction(gripper.up)
    across = (turned @ np.eye(3)[AXES.index(gripper.closing)]).mean(axis=0)
    across -= up * (across @ up)
    if np.linalg.norm(across) < 0.5:
        where = f"{trial.file}: [gripper] closing"
        problem = f"the pads close along {gripper.closing}, which is mostly up and down"
        raise InputError(where, problem, "the axis along which they close, and a quaternion x, y, z, w")
    if window is None:
        # The second derivative of a parabola through n samples has the variance 720 s^2 / (n^5 dt^4).
        period, sd = float(np.median(np.diff(t))), max(white_sd(c) for c in position.T)
        needed = (720 * sd**2 / period**4 / QUIET**2) ** 0.2 * period
        window = float(np.clip(needed, WINDOW, WIDEST))
    velocity, acceleration = (smooth(t, position, deriv, window) for deriv in (1, 2))
    return Pose(t, position, velocity, acceleration, turned, up, across / np.linalg.norm(across), window)


def _turned(trial: Trial, gripper: Gripper) -> np.ndarray:
    """Rotations (num_timesteps, 3, 3) from the tool's axes to the world's."""
    from scipy.spatial.transform import Rotation  # slow to import

    t = trial.t
    if gripper.quaternion is not None:
        q = np.stack([trial.channels[name] for name in gripper.quaternion], axis=1)
        norm = np.linalg.norm(q, axis=1)
        there = np.isfinite(norm)
        if not (np.abs(norm[there] - 1) < 0.05).all():
            row = int(np.flatnonzero(there & ~(np.abs(norm - 1) < 0.05))[0])
            where = f"{trial.file}: row {row + 2}: columns {', '.join(gripper.quaternion)}"
            raise InputError(where, f"a quaternion of norm {norm[row]:.3g}", "a norm of 1 (x, y, z, w)")
        if not there.any():
            raise InputError(f"{trial.file}: column {gripper.quaternion[0]}", "has no complete quaternion")
        signs = np.cumprod(np.r_[1.0, np.where((q[there][1:] * q[there][:-1]).sum(axis=1) < 0, -1, 1)])
        q[there] *= signs[:, None]  # q and -q are one rotation: no jumps between them
        q[~there] = np.nan
        return Rotation.from_quat(np.stack([bridged(c, t) for c in q.T], axis=1)).as_matrix()
    if gripper.rotation_vector is not None:
        names = gripper.rotation_vector
        vectors = np.stack([trial.channels[name] for name in names], axis=1)
        there = np.isfinite(vectors).all(axis=1)
        if not there.any():
            raise InputError(f"{trial.file}: column {names[0]}", "has no complete rotation vector")
        if np.linalg.norm(vectors[there], axis=1).max() > 4 * np.pi:
            where = f"{trial.file}: columns {', '.join(names)}"
            problem = "rotation vectors of more than two turns: they look like degrees"
            remedy = f'{names[0]} = {{unit = "deg"}} and the like under [columns] in rig.toml'
            raise InputError(where, problem, remedy)
        nearest = np.round(np.interp(t, t[there], np.arange(there.sum()))).astype(int)
        return Rotation.from_rotvec(vectors[there][nearest]).as_matrix()
    return np.broadcast_to(np.eye(3), (t.size, 3, 3))


def smooth(t: np.ndarray, values: np.ndarray, deriv: int = 0, window: float = WINDOW) -> np.ndarray:
    """Local parabolas through values (num_timesteps, ...) over `window` s, or their derivative.

    Savitzky and Golay 1964, Anal. Chem. 36. Unevenly spaced samples are interpolated onto an even grid.
    """
    flat = values.reshape(len(t), -1)
    even = np.linspace(t[0], t[-1], len(t))
    period = float(even[1] - even[0])
    length = max(LEAST, round(window / period) // 2 * 2 + 1)
    length = min(length, (len(t) - 1) // 2 * 2 + 1)
    # As scipy.signal.savgol_filter, whose import takes half a second: values in the first and the last half
    # window lie on the first and the last parabola.
    half = length // 2
    steps = np.vander(np.arange(-half, half + 1), 3, increasing=True)
    fit = np.linalg.pinv(steps)
    slopes = [steps, np.pad(steps[:, :2], ((0, 0), (1, 0))) * (0, 1, 2), np.eye(3)[[2] * length] * 2][deriv]
    out = []
    for column in flat.T:
        x = np.interp(even, t, column)
        middle = np.convolve(x, (slopes[half] @ fit)[::-1], mode="valid")
        first, last = (slopes @ (fit @ end) for end in (x[:length], x[-length:]))
        found = np.concatenate([first[:half], middle, last[half + 1 :]]) / period**deriv
        out.append(np.interp(t, even, found))
    return np.stack(out, axis=1).reshape(values.shape)


ROUNDS = 20  # numerics: iterations of the robust fit, which converges sooner
TURNED = 0.02  # chosen: rad, root mean square: a hand that turns less does not show its weight
SAMPLES = 20  # numerics: least samples of free motion
STARTS = 4  # numerics: delays that the fit may start from, half a window apart, to either side of none
DELAY = 0.05  # prior: s; sd of the delay between pose and wrench, two streams of one controller


@dataclass(frozen=True)
class Tool:
    """The tool, from free motion.

    Attributes:
        axes: Q (3, 3).
        shares: (4,) coefficients of the acceleration (inertia) [kg], of the weight [kg] (0 unless
            `weighed`), of the velocity (drag) [N s/m] and of the jerk [kg s] (inertia times what is left of
            the delay).
        delay: of the pose behind the wrench [s], in whole samples.
        weighed: whether the weight was separated from the offset.
        offset, drift: (3,) of the sensor [N, N/s].
        noise: scale of one component of F in free motion about the model [N].
        since: time at which the drift is zero [s].
        drift_sd: standard error of the drift [N/s].
        against: whether the reading contradicts the stated sign.
    """

    axes: np.ndarray
    shares: np.ndarray
    delay: float
    weighed: bool
    offset: np.ndarray
    drift: np.ndarray
    noise: float
    since: float
    drift_sd: float
    against: bool = False

    @property
    def inertia(self) -> float:
        """Its mass by inertia [kg]."""
        return float(self.shares[0])

    @property
    def mass(self) -> float:
        """Its mass by weight [kg], or by inertia if the weight is part of the offset."""
        return float(self.shares[1] if self.weighed else self.shares[0])


@dataclass(frozen=True)
class FreeMotion:
    """Samples of free motion at `t` (n,) [s] with smoothed readings, and all regressors.

    `force` (n, 3) [N]; `regressors` (4, num_timesteps, 3) at `every` (num_timesteps,) [s]: acceleration,
    minus gravity, velocity and jerk, in the axes of the wrench up to a constant rotation; `window` [s]:
    samples nearer to each other are not independent.
    """

    t: np.ndarray
    force: np.ndarray
    every: np.ndarray
    regressors: np.ndarray
    window: float

    def terms(self, delay: float) -> np.ndarray:
        """The regressors (4, n, 3) a `delay` [s] later, to the nearest sample."""
        return self.regressors[:, _nearest(self.every, self.t + delay)]


def wrench_of(trial: Trial, gripper: Gripper) -> np.ndarray:
    """Forces (num_timesteps, 3) as read by the sensor [N], NaN where missing."""
    return np.stack([trial.channels[name] for name in gripper.wrench[:3]], axis=1)


def _nearest(every: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Index (n,) of the one of `every` time (num_timesteps,) that is nearest to each of t (n,)."""
    return np.searchsorted((every[1:] + every[:-1]) / 2, t)


def _regressors(pose: Pose, gripper: Gripper, gravity: float) -> np.ndarray:
    """Acceleration, minus gravity, velocity and jerk (4, num_timesteps, 3), as in `FreeMotion`."""
    weight = np.broadcast_to(gravity * pose.up, pose.acceleration.shape)
    jerk = np.gradient(pose.acceleration, pose.t, axis=0)
    every = (pose.acceleration, weight, pose.velocity, jerk)
    if gripper.frame != "world":
        every = tuple(np.einsum("tji,tj->ti", pose.turned, vectors) for vectors in every)
    return np.stack(every)


def free_motion(trial: Trial, rig: Rig, pose: Pose, free: np.ndarray) -> FreeMotion:
    """Regressors of the samples `free` (num_timesteps,) of a trial."""
    gripper = rig.wrist
    force = np.stack([bridged(c, trial.t) for c in wrench_of(trial, gripper).T], axis=1)
    force = smooth(trial.t, force, window=pose.window)[free]
    every = _regressors(pose, gripper, rig.gravity)
    return FreeMotion(trial.t[free], force, trial.t, every, pose.window)


def free_tool(trial: Trial, rig: Rig, pose: Pose, free: np.ndarray) -> Tool:
    """The tool from samples `free` (num_timesteps,) of free motion; InputError where they leave it open."""
    return tool_of(trial.file, rig, free_motion(trial, rig, pose, free), float(trial.t.mean()))


def tool_of(file: str, rig: Rig, motion: FreeMotion, since: float, between: bool = True) -> Tool:
    """The tool; InputError if free motion does not determine it.

    `between`: whether the tool is used between the samples of free motion. Otherwise a drift of the offset is
    extrapolated only if it is significant.
    """
    gripper = rig.wrist
    where = f"{file}: columns {', '.join(gripper.wrench[:3])}"
    if motion.t.size < SAMPLES:
        raise InputError(where, "show no free motion to find the tool's own share from",
                         "samples before the first grip and after the last")  # fmt: skip
    time = motion.t - since
    axes, found, error, noise, delay = _fit(rig, motion, time)
    if not between and np.all(np.abs(found[7:]) < SURE * error[7:]):
        axes, found, _, noise, delay = _fit(rig, motion, 0 * time)
    left_open = gripper.frame == "sensor" and gripper.sensor_axes is None
    if (left_open or gripper.reaction is None) and abs(found[0]) < SURE * error[0]:
        problem = "do not show the hand's own mass in free motion, so the sensor's axes are undetermined"
        raise InputError(where, problem, 'sensor_axes = ["x", "y", "z"] and reaction = true or false '
                         "under [gripper], as they are mounted")  # fmt: skip
    return Tool(
        axes, found[:4], delay, bool(found[1] != 0.0), axes @ found[4:7], axes @ found[7:], noise, since,
        float(error[7:].max()), bool(gripper.reaction is not None and found[0] < -SURE * error[0]),
    )  # fmt: skip


def _fit(rig: Rig, motion: FreeMotion, time: np.ndarray
         ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:  # fmt: skip
    """Axes, coefficients along them, their standard errors, the noise, and the delay of the pose.

    Robust least squares, in turns with the axes and the delay (Gauss-Newton), of F in the tool's axes on the
    four terms (without the weight if the hand does not turn), the offset (3) and the drift (3).
    """
    gripper, n = rig.wrist, motion.t.size
    weight = motion.terms(0.0)[1]
    turns = gripper.turns and gripper.frame != "world" and _spread(weight) > TURNED * rig.gravity
    given = gripper.tool_mass
    constant = np.broadcast_to(np.eye(3), (n, 3, 3))  # row, axis, parameter
    # Smoothed samples within one window are not independent.
    together = max(1.0, motion.window / float(np.median(np.diff(motion.t))))
    farthest = motion.window / 2  # beyond which the jerk does not continue a smoothed acceleration
    period = float(np.median(np.diff(motion.every)))

    def regressed(delay: float, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Axes, coefficients, their standard errors for unit noise, and the residual (n, 3)."""
        terms = motion.terms(delay)
        moving = np.stack([terms[0], terms[1] * (turns and given is None), terms[2], terms[3]], axis=2)
        rows = np.concatenate([moving, constant, constant * time[:, None, None]], axis=2)
        axes = _axes(gripper, weights, motion.force, terms[0] + terms[1])
        left = motion.force @ axes - (0.0 if given is None else given * terms[1])
        weighed = (rows * weights[:, None, None]).reshape(3 * n, -1).T
        covariance = np.linalg.pinv(weighed @ rows.reshape(3 * n, -1), rcond=1e-14, hermitian=True)
        found = covariance @ (weighed @ left.ravel())
        return axes, found, np.sqrt(np.diag(covariance)), left - rows @ found

    def unlikely(delay: float) -> float:
        """Minus its log density with normal noise."""
        square = float(np.square(regressed(delay, np.ones(n))[3]).mean()) + 1e-12
        return 3 * n / together * np.log(square) + (delay / DELAY) ** 2

    starts = [round(k * farthest / period) * period for k in range(-STARTS, STARTS + 1)]
    following, weights = min(starts, key=unlikely), np.ones(n)
    for _ in range(ROUNDS):
        delay = following
        axes, found, unit, residual = regressed(delay, weights)
        noise = max(robust_sd(residual), 1e-6)
        error = noise * np.sqrt(together) * unit
        weights = (TAIL + 3) / (TAIL + ((residual / noise) ** 2).sum(axis=1))
        doubt = (error[3] / DELAY) ** 2
        step = (found[0] * found[3] - doubt * delay) / (found[0] ** 2 + doubt + 1e-12)
        following = delay + float(np.fix(np.clip(step, -farthest, farthest) / period)) * period
    found[1] = given or found[1] * turns
    return axes, found, error, noise, delay


def _spread(vectors: np.ndarray) -> float:
    """Root mean square distance of vectors (n, 3) from their mean."""
    return float(np.sqrt(((vectors - vectors.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _axes(gripper: Gripper, weights: np.ndarray, force: np.ndarray, felt: np.ndarray) -> np.ndarray:
    """Q (3, 3) as the rig states it, else from the correlation of the reading with the specific force."""
    total = weights.sum()
    f, v = force - weights @ force / total, felt - weights @ felt / total
    together = (weights[:, None] * f).T @ v
    if gripper.sensor_axes is not None or gripper.frame != "sensor":
        stated = np.eye(3)
        if gripper.sensor_axes is not None and gripper.frame == "sensor":
            stated = np.stack([direction(axis) for axis in gripper.sensor_axes])
        against = gripper.reaction
        if against is None:
            against = float(np.trace(stated.T @ together)) < 0
        return -stated if against else stated
    left, size, right = np.linalg.svd(together)
    flip = np.ones(3)
    if gripper.reaction is not None or size[2] < 1e-3 * size[0]:
        flip[2] = (-1.0 if gripper.reaction else 1.0) * np.linalg.det(left @ right)
    return (left * flip) @ right


def applied_force(trial: Trial, rig: Rig, pose: Pose, tool: Tool) -> np.ndarray:
    """Force of the tool on its environment (num_timesteps, 3), in the world's axes [N]."""
    gripper = rig.wrist
    reading = wrench_of(trial, gripper) - tool.offset - tool.drift * (trial.t - tool.since)[:, None]
    later = _nearest(trial.t, trial.t + tool.delay)
    own = np.tensordot(tool.shares, _regressors(pose, gripper, rig.gravity), 1)[later]
    force = reading @ tool.axes - own
    return force if gripper.frame == "world" else np.einsum("tij,tj->ti", pose.turned, force)


OTHER_ORDER = 0.1  # prior: share of rigs that list a quaternion in another order than x, y, z, w


def order_warnings(trial: Trial, rig: Rig, tool: Tool, free: np.ndarray) -> tuple[str, ...]:
    """A line if free motion, samples `free` (num_timesteps,), is better explained by the order w, x, y, z.

    Only for a hand that turns enough to weigh its tool apart from the sensor's offset; else any order fits.
    """
    gripper = rig.wrist
    if gripper.quaternion is None or not tool.weighed:
        return ()
    rolled = (*gripper.quaternion[1:], gripper.quaternion[0])
    other = gripper.model_copy(update={"quaternion": rolled})
    pose = pose_of(trial, other)
    try:
        found = free_tool(trial, rig.model_copy(update={"gripper": other}), pose, free)
    except InputError:
        return ()
    independent = 3 * free.sum() * float(np.median(np.diff(trial.t))) / pose.window
    if independent * np.log(tool.noise / found.noise) < decisive(OTHER_ORDER):
        return ()
    where = f"{trial.file}: columns {', '.join(gripper.quaternion)}"
    problem = f"explain the hand's own share {tool.noise / found.noise:.2g} times better as w, x, y, z"
    return (f"{where} {problem}; expected quaternion = {json.dumps(list(rolled))} under [gripper]",)
