"""The page to walk through: one file, nothing remote, bounded, and safe with any text."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
import torch

from sceneexpander.viewer.packed import BYTES_PER_SPLAT, SPLATS_PER_METHOD, PackedSplats, pack_splats
from sceneexpander.viewer.page import ShownMethod, viewer_page
from tests.worlds.row_of_views import reconstruction

NASTY = '</script><script>alert(1)</script> & "quotes"'


@pytest.fixture(scope="module")
def packed() -> PackedSplats:
    return pack_splats(reconstruction("sceneexpander", [0.0, 0.4, 1.5], generated=1))


def page_of(*methods: PackedSplats, title: str = "room") -> str:
    picture = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(0))
    return viewer_page(title, NASTY, [ShownMethod(splats=item, label=NASTY) for item in methods], {"v0": picture})


def facts_of(page: str) -> dict[str, object]:
    found = re.search(r'<script type="application/json" id="facts">(.*?)</script>', page, re.S)
    assert found is not None
    return dict(json.loads(found[1]))


def test_it_names_no_other_file_and_forbids_remote_ones(packed: PackedSplats) -> None:
    page = page_of(packed)
    assert "default-src 'none'" in page
    assert not re.search(r"(src|href)=", page)
    assert not re.search(r"https?:|//[a-z]+\.", page)


def test_text_from_users_cannot_leave_its_place(packed: PackedSplats) -> None:
    page = page_of(packed, title=NASTY)
    assert "<script>alert" not in page
    assert page.count("<script") == 3, "facts, splats, program"
    assert facts_of(page)["methods"][0]["label"] == NASTY  # type: ignore[index]


def test_counts_are_told(packed: PackedSplats) -> None:
    shown = facts_of(page_of(replace(packed, total=9999)))["methods"][0]  # type: ignore[index]
    assert (shown["count"], shown["total"]) == (packed.count, 9999)


def test_three_full_methods_stay_below_30_mb(packed: PackedSplats) -> None:
    noise = torch.randint(0, 256, (SPLATS_PER_METHOD * BYTES_PER_SPLAT,), generator=torch.Generator().manual_seed(1))
    full = replace(packed, data=noise.to(torch.uint8), total=2 * SPLATS_PER_METHOD)
    # Noise does not compress: no scene is larger. One method is made three times over to spare the test two compressions.
    assert 3 * len(page_of(full)) < 30_000_000


def test_the_same_scene_gives_the_same_bytes(packed: PackedSplats) -> None:
    assert page_of(packed) == page_of(packed)


def test_a_page_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        page_of()
