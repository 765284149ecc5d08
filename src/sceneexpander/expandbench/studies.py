"""What `docs/ablation.md` holds: which rows are measured where. One command measures all of it (``sceneexpander ablation``)."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.expandbench.run import BASELINE

TABLE = ("anchor", "subset_aug", "self_distill", "self_distill_p1", "paper")  # the paper's, after the baseline
BEYOND = (
    "no_realign",
    "no_tone",
    "no_trust",
    "no_free_space",
    "no_close_gaps",
    "corrected",
    "default",
)
CONTROLS = ("control_no_insertion", "control_no_anchor")

# Every cell costs most of a core's minute, so the page shows three kinds of world with one seed; ``--scenes development --seeds 0,1,2``
# measures the nine with three.
SCENES = ("room_2", "corridor_2", "courtyard_1")
UNSEEN = ("room_101", "corridor_101", "open_101", "courtyard_101")

# What every row is compared with to see one component's own effect; rows that are not named: with the default.
REFERENCES = {
    "anchor": BASELINE,
    "subset_aug": "anchor",
    "self_distill": "subset_aug",
    "self_distill_p1": "self_distill",
    "paper": "self_distill",
    "control_no_insertion": "paper",
    "control_no_anchor": "paper",
    "corrected": BASELINE,
    "default": "corrected",
    "gaussian_anchors": "spend_always",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """One set of cells: every row on every scene and grade with every seed.

    Attributes:
        name: for the command line and in the results file.
        title: its heading.
        meaning: what it is for, in a sentence or two.
        overrides: of the configuration, for all rows.
        experiment: the option of ``conf/experiment``.
    """

    name: str
    title: str
    meaning: str
    scenes: tuple[str, ...]
    grades: tuple[str, ...]
    rows: tuple[str, ...]
    seeds: tuple[int, ...]
    overrides: tuple[str, ...] = ()
    experiment: str = "expandbench"


STUDIES = (
    Study(
        name="rows",
        title="The rows, as users get them",
        meaning="All rows, Gaussians fitted to their pictures.",
        scenes=SCENES,
        grades=("mixed_2",),
        rows=(*TABLE, *BEYOND, *CONTROLS),
        seeds=(0,),
    ),
    Study(
        name="predicted",
        title="The rows, as the network makes them",
        meaning="Without the fit, as in the paper, whose methods are feed-forward: here the row `paper` is `method=paper`.",
        scenes=SCENES,
        grades=("mixed_2",),
        rows=(*TABLE, "corrected", "default"),
        seeds=(0,),
        overrides=("refine.visits=0",),
    ),
    Study(
        name="grades",
        title="Against misalignment",
        meaning="The default and the corrections alone, from a faultless inserted picture to a bad one; with the fit.",
        scenes=SCENES,
        grades=("clean", "mixed_2", "mixed_4", "exposure_6", "rotation_10", "translation_10"),
        rows=("corrected", "default"),
        seeds=(0,),
    ),
    Study(
        name="long",
        title="Rows that need many steps",
        meaning="The paper's 400 steps for rows that cannot differ in 30; one scene.",
        scenes=("courtyard_1",),
        grades=("mixed_2",),
        rows=("paper", "corrected", "default", "ema_momentum_099", "restore_interval_1"),
        seeds=(0,),
        experiment="expandbench_long",
    ),
    Study(
        name="spend",
        title="When the steps are run, and what they hold",
        meaning="Every step against steps where the insertion moved something, and with Gaussians among the anchors.",
        scenes=SCENES,
        grades=("mixed_2",),
        rows=("spend_always", "gaussian_anchors", "corrected", "default"),
        seeds=(0,),
    ),
    Study(
        name="free_cameras",
        title="Where the camera head has its say",
        meaning="The variant of the model whose camera head counts in full, for all rows, the baseline among them.",
        scenes=SCENES,
        grades=("mixed_2",),
        rows=("spend_always", "corrected", "default"),
        seeds=(0,),
        overrides=("model.variant=free_cameras",),
    ),
    Study(
        name="test",
        title="Test scenes",
        meaning="Scenes that nothing was chosen on, measured once for this version; with the fit.",
        scenes=UNSEEN,
        grades=("clean", "mixed_2"),
        rows=("paper", "corrected", "default"),
        seeds=(0,),
    ),
)
