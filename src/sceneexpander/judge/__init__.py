"""A vision-language model as a judge of what was rendered, by the paper's two criteria, and of candidates for an inserted view."""

from sceneexpander.judge.ask import Judge, make_judge
from sceneexpander.judge.config import ChatJudgeConfig, JudgeConfig, NoJudgeConfig
from sceneexpander.judge.frames import Shown, shown_of
from sceneexpander.judge.rounds import Work, judge_round

__all__ = [
    "ChatJudgeConfig",
    "Judge",
    "JudgeConfig",
    "NoJudgeConfig",
    "Shown",
    "Work",
    "judge_round",
    "make_judge",
    "shown_of",
]
