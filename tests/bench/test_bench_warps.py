"""`bench warps`: rules of relocalization on views of photos."""

import json

import cv2
import jax
import pytest

from jaxsfm.cli.main import main
from jaxsfm.core.scores import init_scores
from jaxsfm.io.relocalizer import save_relocalizer


@pytest.fixture
def root(tmp_path, photos):
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), photos[0][..., ::-1])
    return folder


@pytest.mark.slow
def test_untrained_scores_measure_as_the_norm_rule_does(root, tmp_path, capsys):
    relocalizer, out = tmp_path / "a.safetensors", tmp_path / "figures.json"
    save_relocalizer(relocalizer, jax.device_get(init_scores(jax.random.key(0), hidden=2)), {})
    args = ["bench", "warps", "--root", str(root), "--seeds", "1", "--json", str(out)]
    assert main([*args, "--relocalizer", str(relocalizer)]) == 0
    rows = json.loads(out.read_text())["summary"]
    assert rows["norm"] == rows["learned"]
    assert 0 < rows["norm"]["within_1"]["mean"] < rows["norm"]["within_3"]["mean"] < 1
    text = capsys.readouterr().out
    assert "synthetic" in text and "learned / norm: 1.00 within 1 px, 1.00 within 3 px" in text


def test_misuse_gets_one_sentence(root, tmp_path, capsys):
    for args, words in (
        (["--root", str(tmp_path / "none")], "no such folder"),
        (["--root", str(root), "--methods", "best"], "no method 'best'"),
        (["--root", str(root), "--seeds", "0"], "--seeds"),
    ):
        assert main(["bench", "warps", *args]) == 2
        assert words in capsys.readouterr().err
