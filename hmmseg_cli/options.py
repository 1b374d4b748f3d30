"""Arguments and options of all commands: type, flag and line of help."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

BLOCKS = "Blocks against the virtual model (what --task and --rig describe)"
GIVEN = "Recordings against simulated trials of your own"
ROBOT = "A robot against your own model of it"


Segmenter = Literal["hmm", "qualitative"]
Estimator = Literal["bayes", "paper"]
Hand = Literal["cartesian", "jointed", "gripper", "none"]
Animation = Literal["gif", "mp4"]
File = Path | None
Names = list[str] | None
Paths = list[Path] | None


def option(flag: str, metavar: str | None, text: str, *, of: str | None = None, **more: Any) -> Any:
    """An option with its help, in the group `of` if one is named."""
    return typer.Option(*flag.split(), metavar=metavar, help=text, rich_help_panel=of, **more)


def argument(metavar: str, text: str) -> Any:
    """An argument with its help."""
    return typer.Argument(metavar=metavar, help=text)


# fmt: off
# What several commands share.
Trials = Annotated[list[Path], argument("TRIAL...",
    "Recordings (CSV, Parquet, NPZ, MCAP, ...); several are pooled.")]
Task = Annotated[Path, option("--task", "T", "Task description (TOML).")]
Rig = Annotated[Path, option("--rig", "R", "Nominal hand (TOML).")]
TaskFound = Annotated[File, option("--task", "T",
    "Task description; task.toml next to the trials by default.")]
RigFound = Annotated[File, option("--rig", "R", "Nominal hand; rig.toml next to the trials by default.")]
Actual = Annotated[File, option("--actual", "A", "Properties measured independently (TOML).")]
Json = Annotated[str | None, option("--json", "FILE", "Write the result as JSON; - is standard output.")]
Figures = Annotated[File, option("--figures", "DIR", "Draw the figures into this folder.")]
Report = Annotated[File, option("--report", "FILE.html", "Write one self-contained page.")]
Seed = Annotated[int, option("--seed", "N", "Seed of all random draws.", min=0)]
UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True, min=0)]  # taken, where nothing is random
Quiet = Annotated[bool, option("--quiet", None, "Print nothing but errors; warnings are in the JSON.")]

# decompose, inspect, new, demo, fit
TaskArgument = Annotated[Path, argument("TASK", "Task description (TOML).")]
Files = Annotated[list[Path], argument("FILE...", "Recordings of any kind.")]
JudgingRig = Annotated[File, option("--rig", "R", "Judge the recording with this hand and mapping.")]
WrittenRig = Annotated[File, option("--write", "RIG.toml",
    "Add the proposed mapping to this rig, or make it.")]
Folder = Annotated[Path, argument("FOLDER", "Where the files are written.")]
HandKind = Annotated[Hand | None, option("--hand", None,
    "Fingertips, two-link fingers, a gripper, or none (an ordered task).")]
Source = Annotated[File, option("--from", "FILE", "Fill in hand, rate and columns from this recording.")]
LaidOutModel = Annotated[File, option("--model --mjcf", "XML",
    "Lay out a map.toml of this model and --from's log.")]
DemoFigures = Annotated[Path, option("--figures", "DIR", "Folder for the figures.")]
KnownLabels = Annotated[File, option("--labels", "FILE|DIR",
    "What is known of some boundaries: a folder with NAME.json, or a .csv.")]
ModelToWrite = Annotated[Path, option("--model", "M.npz", "Where the model is written.")]

# segment, identify, watch
LearnedModel = Annotated[File, option("--model", "M.npz", "Emissions of an ordered task, from hmmseg fit.")]
SegmentMethod = Annotated[Segmenter, option("--method", None, "hmm, or the paper's thresholds.")]
ForceThreshold = Annotated[float, option("--force-threshold", "N",
    "Of forces, qualitative method [N].", min=0.0)]
VelocityThreshold = Annotated[float, option("--velocity-threshold", "M/S",
    "Of velocities, likewise.", min=0.0)]
WrittenLabels = Annotated[File, option("--write", "FILE",
    "Write the recording with subtask columns (.csv, .parquet) or a topic (.mcap); for several "
    "recordings, or a LeRobot data set, a folder.")]
Workers = Annotated[int | None, option("--workers", "N",
    "Fit each recording by itself, in N processes.", min=1)]
Scheduler = Annotated[str | None, option("--scheduler", "ADDRESS",
    "The same on a Dask cluster, as tcp://host:8786; local: one of this machine.")]
IdentifyMethod = Annotated[Estimator, option("--method", None,
    "Bayesian, or the paper's thresholds and formulas.")]
Lag = Annotated[float, option("--lag", "S", "How long to wait before a boundary is settled [s].", min=0.0)]
Plot = Annotated[bool, option("--plot", None, "Show it live in the terminal (standard error).")]
SkipBadRows = Annotated[bool, option("--skip-bad-rows", None,
    "Leave out rows that cannot be read, instead of stopping.")]

# simulate, play
Properties = Annotated[File, option("--properties", "P", "identify's JSON or actual.toml; else the paper's.")]
Replay = Annotated[File, option("--replay", "TRIAL", "Drive the model with this recording's motions.")]
Count = Annotated[int, option("--trials", "N", "How many trials.", min=1, max=99)]
SimulatedFolder = Annotated[Path, option("--output", "DIR", "Folder to write into.")]
Operator = Annotated[File, option("--operator", "FILE", "How the operator works (TOML or JSON).")]
Animated = Annotated[bool, option("--animation", None,
    "Draw fingers and blocks in motion next to the forces.")]
AnimationFormat = Annotated[Animation, option("--animation-format", None, "Kind of animation.")]
PlayedProperties = Annotated[File, argument("[PROPERTIES]",
    "identify's or diagnose's JSON, or an actual.toml.")]
PlayedTask = Annotated[File, option("--task", "T", "How the blocks stand (TOML).")]
PlayedRig = Annotated[File, option("--rig", "R", "Pads and recording (TOML).")]
PlayedBlocks = Annotated[File, option("--blocks", "P",
    "A diagnosis's blocks: identify's JSON or an actual.toml.")]
PlayedEffect = Annotated[Names, option("--effect", "NAME", "Switched on in addition to the nominal world.")]
SavedFolder = Annotated[Path, option("--output", "DIR", "Where trials are saved.")]
Port = Annotated[int, option("--port", None, "Port of the page; 0: any free.", min=0, max=65535)]
OpenPage = Annotated[bool, option("--open/--no-open", None, "Open the page in the browser.")]

# diagnose, calibrate
ActualBlocks = Annotated[File, option("--actual", "A",
    "Properties measured independently of the trials (TOML).", of=BLOCKS)]
Healthy = Annotated[Paths, option("--healthy", "TRIAL...",
    "Recordings known to be healthy, the best null; by default the stated noise. With a model of a robot: "
    "its earlier logs, to find what changed.")]
Against = Annotated[Paths, option("--against", "SIM...",
    "Simulated trials to compare with; a plain ordered task needs them.", of=GIVEN)]
ModelOrEmissions = Annotated[File, option("--model", "M",
    "Emissions (.npz) of a plain ordered task, by hmmseg fit; or as --mjcf.", of=GIVEN)]
Effect = Annotated[Names, option("--effect", "NAME",
    "The cause, instead of choosing one; repeated, they act together.")]
Patch = Annotated[File, option("--patch", "DIR",
    "Write the corrected model and its ranges into this folder.")]
Simulator = Annotated[str | None, option("--simulator", "FILE.py:NAME",
    "Your own model instead of the virtual blocks.", of=ROBOT)]
Mjcf = Annotated[File, option("--mjcf", "XML",
    "Your own model, as MuJoCo reads it; it needs --map.", of=ROBOT)]
RobotModel = Annotated[File, option("--model --mjcf", "XML", "The robot's model, as MuJoCo reads it.")]
Map = Annotated[File, option("--map", "MAP.toml",
    "Which column of the logs is which joint, actuator, sensor or body, in what unit.", of=ROBOT)]
Candidate = Annotated[Names, option("--candidate", "NAME",
    "Add a parameter of the MJCF model to the candidates, such as joint:elbow.frictionloss.", of=ROBOT)]
History = Annotated[File, option("--history", "FILE.jsonl",
    "Add this run's intervals to that file, and say what has moved.", of=ROBOT)]
Rerun = Annotated[File, option("--rerun", "FILE.rrd",
    "Recorded, simulated and corrected, for Rerun's viewer.", of=ROBOT)]
