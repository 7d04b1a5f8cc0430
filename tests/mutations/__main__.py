"""Flip operators in modules without kernels, one at a time, and run the tests of the module.

    python -m tests.mutations --only quick --count 60 --least 0.6

The seed ranks all mutants, so that every machine draws the same ones, and a change in one module
does not change the mutants drawn from others. No file is changed: a mutant exists only in a forked
process, which imports it. The test files in `JUDGED_BY` judge a module. They first run without a
mutant to find the tests that reach each line; the files with such tests judge the mutants of the
line. A mutant is killed if a test fails, or if the tests take far longer than without it; a mutant
that no test reaches has survived.
"""

import argparse
import hashlib
import importlib
import multiprocessing
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from pathlib import Path

from tests.mutations.attempts import ROOT, Mutant, Reached, attempt, reach
from tests.mutations.flips import flips_of

LIBRARIES = ("numba", "scipy.spatial.transform", "pyarrow.parquet", "rosbags.typesys",
             "mcap.reader", "mcap_ros2.decoder", "click.testing", "scipy.optimize")  # fmt: skip
"""Loaded once, before processes are forked."""
PACKAGES = ("batch", "cameras", "cli", "colour", "completion", "depth_fusion", "evaluation",
            "executors", "learning", "outputs", "recordings", "reuse", "runs", "system",
            "tracking")  # fmt: skip
FILES = ("config", "models.sets", "perception", "pipeline")
"""Modules beside the packages."""
JUDGED_BY: dict[str, Sequence[str]] = {
    "shapecat.batch": ("test_batch_planning",),
    "shapecat.batch.ledger": ("test_batch_planning", "test_batch"),
    "shapecat.batch.runs": ("test_batch_planning", "test_batch"),
    "shapecat.batch.claims": ("test_remote",),
    "shapecat.batch.remote": ("test_remote",),
    "shapecat.batch.finding_urls": ("test_remote", "test_batch_planning"),
    "shapecat.batch.sources": ("test_batch_planning", "test_batch"),
    "shapecat.batch.storage": ("test_remote",),
    "shapecat.cameras": ("test_cameras", "test_colour", "test_recordings_colour"),
    "shapecat.cli": ("test_commands_worked", "test_command_line", "test_pipeline",
                     "test_exports_readback", "test_boxes_in_outputs"),
    "shapecat.cli.compare": ("test_compare",),
    "shapecat.cli.evaluate": ("test_evaluation", "test_command_line"),
    "shapecat.cli.export": ("test_exports", "test_exports_readback", "test_command_line"),
    "shapecat.cli.outcomes": ("test_commands_worked", "test_batch", "test_pipeline"),
    "shapecat.cli.process": ("test_commands_worked", "test_command_line", "test_pipeline",
                             "test_batch", "test_colour_outputs"),
    "shapecat.cli.progress": ("test_commands_worked", "test_command_line", "test_batch"),
    "shapecat.cli.report": ("test_report", "test_report_serve"),
    "shapecat.colour": ("test_colour", "test_colour_outputs", "test_exports_images"),
    "shapecat.completion": ("test_completion", "test_tables_rotated"),
    "shapecat.config": ("test_config",),
    "shapecat.depth_fusion": ("test_depth_fusion",),
    "shapecat.evaluation": ("test_evaluation", "test_evaluation_dataset"),
    "shapecat.evaluation.comparison": ("test_compare",),
    "shapecat.evaluation.comparison.identities": ("test_identities", "test_compare"),
    "shapecat.evaluation.comparison.overlap": ("test_compare", "test_identities"),
    "shapecat.executors": ("test_executors", "test_batch"),
    "shapecat.learning": ("test_learning", "test_learning_model_file"),
    "shapecat.models.sets": ("test_learning_default_model",),
    "shapecat.outputs": ("test_outputs_worked", "test_annotations_rotated",
                         "test_annotated_mcap", "test_exports_worked"),
    "shapecat.outputs.annotation.annotated_mcap": ("test_outputs_worked", "test_annotated_mcap",
                                                   "test_annotations_rotated", "test_pipeline"),
    "shapecat.outputs.annotation.image_annotations": ("test_outputs_worked", "test_colour_outputs",
                                                      "test_annotations_rotated"),
    "shapecat.outputs.colouring": ("test_colour_outputs", "test_exports_images",
                                   "test_outputs_worked"),
    "shapecat.outputs.exports": ("test_outputs_worked", "test_exports_worked", "test_exports",
                                 "test_exports_images"),
    "shapecat.outputs.exports.dataset_frames": ("test_outputs_worked", "test_exports_worked",
                                                "test_exports_images", "test_exports_readback"),
    "shapecat.outputs.in_memory": ("test_api",),
    "shapecat.outputs.level_clouds": ("test_outputs_worked", "test_exports_worked",
                                      "test_exports"),
    "shapecat.outputs.opened_run": ("test_api",),
    "shapecat.outputs.report": ("test_report_worked", "test_report_counts", "test_report",
                                "test_report_serve"),
    "shapecat.outputs.review": ("test_review_worked", "test_review", "test_outputs_worked"),
    "shapecat.outputs.scene_graph": ("test_detection", "test_outputs_worked"),
    "shapecat.outputs.scene_tree": ("test_outputs_worked", "test_exports"),
    "shapecat.outputs.wording": ("test_outputs_worked",),
    "shapecat.perception": ("test_views_worked", "test_reuse", "test_depth_fusion", "test_gravity",
                            "test_pipeline", "test_tables_truth"),
    "shapecat.pipeline": ("test_pipeline", "test_crash", "test_resuming", "test_colour_outputs",
                          "test_command_line", "test_label_transfer", "test_tables_truth"),
    "shapecat.recordings": ("test_recordings_worked", "test_recordings_frames", "test_cameras",
                            "test_recordings", "test_recordings_colour", "test_recordings_streams",
                            "test_recordings_damaged", "test_changes"),
    "shapecat.recordings.colour": ("test_recordings_worked", "test_recordings_colour",
                                   "test_colour", "test_changes", "test_viewpoint"),
    "shapecat.recordings.colour_motion": ("test_colour_motion",),
    "shapecat.recordings.containers.mcap": ("test_recordings_worked", "test_annotated_mcap",
                                            "test_recordings", "test_recordings_damaged",
                                            "test_recordings_frames"),
    "shapecat.recordings.containers.ros": ("test_recordings_worked", "test_recordings",
                                           "test_recordings_damaged", "test_annotated_mcap"),
    "shapecat.recordings.decoding.colour_image": ("test_recordings_worked", "test_colour",
                                                  "test_recordings_colour", "test_changes"),
    "shapecat.recordings.decoding.decoders": ("test_recordings_foxglove", "test_recordings",
                                              "test_changes"),
    "shapecat.recordings.decoding.foxglove": ("test_recordings_foxglove",),
    "shapecat.recordings.decoding.protobuf": ("test_recordings_foxglove",),
    "shapecat.recordings.files": ("test_batch_planning", "test_recordings"),
    "shapecat.recordings.look_ahead": ("test_look_ahead", "test_recordings_foxglove"),
    "shapecat.recordings.transforms": ("test_recordings_worked", "test_transforms",
                                       "test_cameras", "test_look_ahead"),
    "shapecat.recordings.transforms.delays": ("test_transform_clocks",),
    "shapecat.recordings.transforms.extrinsics": ("test_recordings_worked", "test_changes",
                                                  "test_recordings_colour"),
    "shapecat.recordings.transforms.gravity": ("test_cameras", "test_gravity", "test_changes"),
    "shapecat.recordings.transforms.imu": ("test_gravity", "test_look_ahead"),
    "shapecat.recordings.viewpoint": ("test_viewpoint",),
    "shapecat.reuse": ("test_reuse",),
    "shapecat.runs": ("test_tables_rotated", "test_tables", "test_batch_planning", "test_labels"),
    "shapecat.runs.finished": ("test_tables_truth", "test_exports", "test_report", "test_labels"),
    "shapecat.runs.folder": ("test_run_folder", "test_batch_planning"),
    "shapecat.runs.full_boxes": ("test_tables_rotated", "test_completion"),
    "shapecat.runs.labels": ("test_outputs_worked", "test_labels", "test_label_transfer"),
    "shapecat.runs.labels.far_merges": ("test_far_merges",),
    "shapecat.runs.labels.same_objects": ("test_label_transfer",),
    "shapecat.runs.labels.track_table": ("test_labels", "test_label_transfer"),
    "shapecat.runs.labels.transfer": ("test_label_transfer",),
    "shapecat.runs.perceive.centers": ("test_misplacement", "test_colour_offsets"),
    "shapecat.runs.perceive.clocks": ("test_several_streams", "test_transform_clocks"),
    "shapecat.runs.perceive.colour_offsets": ("test_colour_offsets",),
    "shapecat.runs.perceive.doubts": ("test_doubts", "test_missing_planes", "test_pose_jumps"),
    "shapecat.runs.perceive.misplacement": ("test_misplacement",),
    "shapecat.runs.perceive.missing_planes": ("test_missing_planes",),
    "shapecat.runs.perceive.phases": ("test_pipeline", "test_crash", "test_second_look"),
    "shapecat.runs.perceive.pose_jumps": ("test_pose_jumps",),
    "shapecat.runs.perceive.resuming": ("test_resuming", "test_batch_planning", "test_pipeline"),
    "shapecat.runs.perceive.second_look": ("test_second_look",),
    "shapecat.runs.perceive.up_report": ("test_gravity",),
    "shapecat.runs.perceive.up_check": ("test_gravity", "test_second_look"),
    "shapecat.runs.selection": ("test_recordings_frames", "test_pipeline"),
    "shapecat.runs.tables.masks": ("test_colour_outputs", "test_exports_images"),
    "shapecat.runs.tables.placed_frames": ("test_changes", "test_tables_rotated"),
    "shapecat.runs.tables.segments": ("test_tables", "test_tables_rotated", "test_batch_planning"),
    "shapecat.system": ("test_run_folder", "test_batch_planning"),
    "shapecat.system.stopping": ("test_stopping", "test_run_folder"),
    "shapecat.tracking": ("test_tracking_worked", "test_tracking", "test_tables_rotated",
                          "test_changes", "test_reuse"),
}  # fmt: skip
"""Test files by prefix of a module's name; the longest prefix counts."""
SLOW = (
    "shapecat.batch.claims",
    "shapecat.batch.finding_urls",
    "shapecat.batch.ledger",
    "shapecat.batch.remote",
    "shapecat.batch.runs",
    "shapecat.batch.sources",
    "shapecat.batch.storage",
    "shapecat.cli",
    "shapecat.depth_fusion",
    "shapecat.evaluation",
    "shapecat.executors",
    "shapecat.outputs.report",
    "shapecat.outputs.review",
    "shapecat.perception",
    "shapecat.pipeline",
    "shapecat.runs.perceive.phases",
    "shapecat.runs.perceive.resuming",
    "shapecat.runs.perceive.second_look",
    "shapecat.system.stopping",
)
"""Modules whose tests need browsers, viewers, storage, recordings or commands; not in `quick`."""


def modules(only: str) -> dict[str, Path]:
    """Return the files of modules without kernels, by name: those whose name contains ``only``.

    For ``quick``, return all but those of `SLOW`.
    """
    folders = {package: ROOT / "shapecat" / package for package in PACKAGES} | {"cli": ROOT / "cli"}
    named = {
        ".".join(("shapecat", package, *file.relative_to(folder).with_suffix("").parts)): file
        for package, folder in folders.items()
        for file in folder.rglob("*.py")
    } | {f"shapecat.{name}": ROOT / "shapecat" / f"{name.replace('.', '/')}.py" for name in FILES}
    return {
        name: file
        for name, file in named.items()
        if (not name.startswith(SLOW) if only == "quick" else only in name)
        and not name.endswith("__init__")
        and "@kernel" not in file.read_text("utf-8")
    }


def sample(seed: int, count: int | None, only: str) -> list[Mutant]:
    """Return the ``count`` mutants that a seed ranks first, or all; ``only`` is as in `modules`."""
    mutants = [
        Mutant(name, file, flip)
        for name, file in modules(only).items()
        for flip in flips_of(file.read_text("utf-8"))
    ]
    return sorted(mutants, key=lambda mutant: _rank(seed, mutant))[:count]


def _rank(seed: int, mutant: Mutant) -> bytes:
    return hashlib.sha256(f"{seed} {mutant.module} {mutant.flip.position}".encode()).digest()


def tests_of(mutant: Mutant) -> list[Path]:
    """Return the test files that judge a mutant, and its module if that has doctests."""
    fitting = max((name for name in JUDGED_BY if mutant.module.startswith(name)), key=len)
    files = [ROOT / "tests" / f"{name}.py" for name in JUDGED_BY[fitting]]
    return [mutant.file, *files] if "\n    >>> " in mutant.file.read_text("utf-8") else files


def judge(mutant: Mutant, reached: Mapping[Path, Reached | None]) -> tuple[Mutant, str]:
    """Return a mutant and its outcome; the tests that reach it run first, then those beside them.

    The outcome is ``not judged`` if no test reaches the mutant, but a test file fails without it.
    """
    judges = {file: reached[file] for file in tests_of(mutant)}
    reaching = {file: result for file, result in judges.items() if result and result.by(mutant)}
    if not reaching:
        return mutant, "not judged" if None in judges.values() else "survived"
    first = [test for result in reaching.values() for test in result.by(mutant)]
    allowed_s = 20 + 4 * sum(result.seconds for result in reaching.values())
    return mutant, attempt(mutant, list(reaching), first, allowed_s)


def main() -> int:
    """Print the outcome of each mutant, and the fraction killed; return 1 if that is too small."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, help="mutants, all if absent")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the names of modules, or quick")
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--least", type=float, default=0.8, help="share that has to be killed")
    options = parser.parse_args()
    for name in LIBRARIES:
        importlib.import_module(name)
    mutants = sample(options.seed, options.count, options.only)
    files = sorted({file for mutant in mutants for file in tests_of(mutant)})
    counts: Counter[str] = Counter()
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("fork")) as pool:
        reached = _traced(files, pool)
        for mutant, outcome in pool.map(partial(judge, reached=reached), mutants):
            counts[outcome] += 1
            where = f"{mutant.file.relative_to(ROOT)}:{mutant.flip.line}"
            print(
                f"{counts.total()}/{len(mutants)} {outcome}: {where}: {mutant.flip.what}",
                flush=True,
            )
    killed = counts.total() - counts["survived"] - counts["not judged"]
    share = killed / max(counts.total(), 1)
    print(f"{killed} of {counts.total()} mutants killed, {share:.0%}, with seed {options.seed}: "
          f"{', '.join(f'{count} {outcome}' for outcome, count in counts.items())}")  # fmt: skip
    return int(share < options.least)


def _traced(files: Sequence[Path], pool: Executor) -> dict[Path, Reached | None]:
    """Run test files without a mutant; return what each reaches, or None for a file that fails."""
    found = {}
    for file, result in zip(files, pool.map(_reach, files), strict=True):
        took = "fails" if result is None else f"{result.seconds:.1f} s"
        print(f"{file.name} without a mutant: {took}", flush=True)
        found[file] = result
    return found


def _reach(file: Path) -> Reached | None:
    return reach(file) or reach(file)  # again, as the machine may be busy


if __name__ == "__main__":
    sys.exit(main())
