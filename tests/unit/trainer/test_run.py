"""From annotated images to a bundle that the product loads: whole runs, stopped, killed and taken up again."""

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from typer.testing import CliRunner

from l3ps.errors import Cancelled, InputError
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.session import Segmenter
from l3ps_trainer import checkpoint, training
from l3ps_trainer.command import app
from l3ps_trainer.recipe import CPU, RECIPES
from l3ps_trainer.reporting import silent
from l3ps_trainer.run import WORK, Request, run


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """A recipe of a second."""
    monkeypatch.setitem(RECIPES, "cpu", replace(CPU, epochs=20, views=3, rate=1e-2, hardest=0.5))


def wish(street, out, **changes):
    backbone = f"onnx:{street / 'backbone.onnx'}"
    usual = Request(street / "known", backbone, out, "tiny", recipe="cpu", classes=street / "classes.json", threads=1)
    return replace(usual, **changes)


def weights(out):
    return torch.load(out / WORK / checkpoint.NAME, weights_only=True)["weights"]


def same(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def whole(street, tmp_path_factory):
    """One undisturbed run: where it wrote, what it reported and what it told on the way."""
    out, told = tmp_path_factory.mktemp("whole") / "out", []

    def listen(step, done, total, **figures):
        told.append((step, done, total, figures))

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(RECIPES, "cpu", replace(CPU, epochs=20, views=3, rate=1e-2, hardest=0.5))
        report = run(wish(street, out, validation=street / "unseen"), listen)
    return out, report, told


def test_a_few_steps_learn_what_brightness_tells(whole):
    _, report, told = whole
    assert report["validation"]["miou"] > 90
    assert set(report["validation"]["classes"]) == {"car", "road", "vegetation"}
    assert report["validation"]["classes"]["vegetation"] is None
    assert [step for step, done, total, _ in told if done == total] == ["features", "train", "export", "validate"]
    assert any("miou" in figures for step, _, _, figures in told if step == "train"), "an early figure"


def test_the_report_says_what_nobody_could_learn(whole):
    out, report, _ = whole
    assert report["never_occur"] == ["vegetation"]
    assert report["images"] == 3
    assert report["agreement"]["probability"] <= 1e-3
    assert json.loads((out / "report.json").read_text())["validation"] == report["validation"]
    page = (out / "report.md").read_text()
    assert "never found: vegetation" in page
    assert "| car |" in page


def test_the_bundle_labels_images_in_the_product(whole, image):
    out, _, _ = whole
    bundle = ModelBundle.load(out)
    assert bundle.info.classes == ("car", "road", "vegetation"), "void is never taught, so the network does not know it"
    assert bundle.info.lut.tolist() == [4, 11, 16]
    labels = Segmenter(bundle, threads=1).segment(image.rgb)
    columns = labels.semantic.shape[1]
    assert (labels.semantic[:, : columns * 4 // 10] == 4).mean() > 0.9
    assert (labels.semantic[:, columns * 6 // 10 :] == 11).mean() > 0.9
    assert b".py" not in (out / "model.onnx").read_bytes(), "no trace of the machine it was exported on"
    assert {p.name for p in out.iterdir()} == {"model.onnx", "model.json", "report.json", "report.md", WORK}


def test_without_instances_there_is_no_boundary_head(street, tmp_path):
    for part in ("images", "semantic"):
        (tmp_path / "plain").mkdir(exist_ok=True)
        (tmp_path / "plain" / part).symlink_to(street / "known" / part)
    report = run(wish(street, tmp_path / "out", annotations=tmp_path / "plain", epochs=1), silent)
    assert not report["has_instances"]
    assert ModelBundle.load(tmp_path / "out").info.output.boundary is None
    assert report["validation"] is None
    assert "how good it is remains unknown" in (tmp_path / "out" / "report.md").read_text()


def before_export(step, done, total, **figures):
    """A reporter that stops a run when its weights are known."""
    if step == "export":
        raise Cancelled("stop")


@pytest.mark.parametrize("moment", [("features", 5), ("train", 7)])
def test_a_stopped_run_taken_up_again_ends_with_the_same_weights(street, tmp_path, whole, moment):
    def stopping(step, done, total, **figures):
        if (step, done) == moment:
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        run(wish(street, tmp_path / "out"), stopping)
    assert not (tmp_path / "out" / "model.onnx").exists()
    first = []
    run(wish(street, tmp_path / "out"), lambda step, done, total, **f: first.append((step, done)))
    assert moment != ("train", 7) or (("train", 8) in first and ("train", 7) not in first), "it goes on, not anew"
    assert same(weights(tmp_path / "out"), weights(whole[0]))


CHILD = """
import sys
from dataclasses import replace
from l3ps_trainer import training
from l3ps_trainer.recipe import CPU, RECIPES
training.SAVED_EVERY = 0
RECIPES["cpu"] = replace(CPU, epochs=20, views=3, rate=1e-2, hardest=0.5)
from l3ps_trainer.command import app
app(sys.argv[1:])
"""


def arguments(street, out, *more):
    command = [
        "train",
        street / "known",
        "--recipe",
        "cpu",
        "--backbone",
        f"onnx:{street / 'backbone.onnx'}",
        "--out",
        out,
        "--threads",
        1,
    ]
    return [str(a) for a in (*command, "--classes", street / "classes.json", "--name", "tiny", "--events", *more)]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_run_taken_up_again_ends_with_the_same_weights(street, tmp_path, whole, number):
    command = [sys.executable, "-c", CHILD, *arguments(street, tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            event = json.loads(line)
            if event["step"] == "train":
                process.send_signal(number)
                break
        process.stdout.read()
    assert process.returncode == (-9 if number == signal.SIGKILL else 143)
    content = torch.load(tmp_path / "out" / WORK / checkpoint.NAME, weights_only=True)
    assert content["step"] >= event["done"]
    with pytest.raises(Cancelled):
        run(wish(street, tmp_path / "out"), before_export)
    assert same(weights(tmp_path / "out"), weights(whole[0]))


def test_events_are_lines_of_json_and_nothing_else(street, tmp_path):
    result = CliRunner().invoke(app, arguments(street, tmp_path / "out", "--epochs", 1))
    assert result.exit_code == 0
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert {e["step"] for e in events[:-1]} == {"features", "train", "export"}
    assert events[-1]["event"] == "done"
    assert events[-1]["report"]["name"] == "tiny"
    assert "never occur" in result.stderr


@pytest.mark.parametrize(
    ("wrong", "code", "told"),
    [
        (("--size", "33x64"), "bad-size", "There are: 32x64"),
        (("--size", "large"), "bad-size", "448x798"),
        (("--recipe", "none"), "unknown-recipe", "published"),
        (("--validation", "1.5"), "out-of-range", "between 0 and 1"),
        (("--format", "none"), "unknown-format", "cityscapes"),
        (("--weights", "w.pth"), "bad-option", "Leave it out"),
    ],
)
def test_bad_input_ends_with_its_problems_and_exit_code_2(street, tmp_path, wrong, code, told):
    result = CliRunner().invoke(app, arguments(street, tmp_path / "out", *wrong))
    assert result.exit_code == 2
    event = json.loads(result.stdout)
    assert event["event"] == "error"
    assert event["problems"][0]["code"] == code
    assert told in result.stderr


def test_other_settings_beside_a_checkpoint_are_refused_until_fresh(street, tmp_path, whole):
    with pytest.raises(Cancelled):
        run(wish(street, tmp_path / "out", epochs=1), before_export)
    with pytest.raises(InputError, match=r"recipe, seed differ.*--fresh"):
        run(wish(street, tmp_path / "out", epochs=2, seed=1), silent)
    with pytest.raises(Cancelled):
        run(wish(street, tmp_path / "out", fresh=True), before_export)
    assert same(weights(tmp_path / "out"), weights(whole[0]))


def test_the_seed_decides_the_weights(street, tmp_path, whole):
    with pytest.raises(Cancelled):
        run(wish(street, tmp_path / "out", seed=1), before_export)
    assert not same(weights(tmp_path / "out"), weights(whole[0]))


def test_a_share_of_the_images_is_kept_apart(street, tmp_path):
    report = run(wish(street, tmp_path / "out", validation=0.3, epochs=1), silent)
    assert report["images"] == 2
    assert report["validation"]["images"] == 1


def test_a_small_network_is_trained_whole_from_scratch(street, tmp_path, monkeypatch):
    recipe = replace(RECIPES["scratch"], epochs=2, size=(32, 64), view_size=(32, 48))
    monkeypatch.setitem(RECIPES, "scratch", recipe)
    report = run(wish(street, tmp_path / "one", backbone="scratch", recipe="scratch"), silent)
    with pytest.raises(Cancelled):
        run(wish(street, tmp_path / "other", backbone="scratch", recipe="scratch"), before_export)
    assert same(weights(tmp_path / "one"), weights(tmp_path / "other"))
    assert report["agreement"]["equal"] == 1
    assert any("running_mean" in name for name in weights(tmp_path / "one")), "the backbone is in the checkpoint"


def test_a_second_graph_serves_the_balanced_preset(street, graph, tmp_path):
    (tmp_path / "graphs").mkdir()
    for size in ((32, 64), (64, 128)):
        graph(tmp_path / "graphs" / f"{size[0]}.onnx", size)
    backbone = f"onnx:{tmp_path / 'graphs'}"
    run(wish(street, tmp_path / "out", backbone=backbone, size=(32, 64), balanced=(64, 128), epochs=1), silent)
    described = json.loads((tmp_path / "out" / "model.json").read_text())
    assert described["input"]["height"] == 32
    assert described["passes"] == {"balanced": {"graph": "model-balanced.onnx", "height": 64, "width": 128}}
    larger = onnx.load(tmp_path / "out" / "model-balanced.onnx").graph
    assert [d.dim_value for d in larger.output[0].type.tensor_type.shape.dim] == [1, 3, 16, 32]


@pytest.mark.parametrize("allowed", [0.5, -1000])
def test_int8_is_delivered_where_validation_allows_it(street, tmp_path, whole, monkeypatch, allowed):
    monkeypatch.setattr("l3ps_trainer.run.KEPT_WITHIN", allowed)
    shutil.copytree(whole[0] / WORK, tmp_path / "out" / WORK)
    steps = []
    request = wish(street, tmp_path / "out", validation=street / "unseen", int8=True)
    report = run(request, lambda step, done, total, **figures: steps.append(step))
    assert not {"features", "train"} & set(steps), "a finished training is exported anew, not made anew"
    assert report["int8"]["kept"] == (allowed > 0)
    assert report["int8"]["float_miou"] == report["validation"]["miou"]
    assert ModelBundle.load(tmp_path / "out").info.name == "tiny"
    assert not list((tmp_path / "out").glob("int8*"))


def test_a_place_that_cannot_be_written_to_is_told(street, tmp_path):
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(app, arguments(street, tmp_path / "file" / "out"))
    assert result.exit_code == 2
    assert "Name a place" in result.stderr


def test_int8_needs_images_to_prove_itself_on(street, tmp_path):
    with pytest.raises(InputError, match="--validation"):
        run(wish(street, tmp_path / "out", int8=True), silent)


def test_the_checkpoint_is_never_half_written(tmp_path, monkeypatch):
    checkpoint.save(tmp_path, {"step": 1}, {})

    def breaking(content, file):
        file.write(b"half")
        raise OSError("the disk is full")

    monkeypatch.setattr(torch, "save", breaking)
    with pytest.raises(OSError, match="full"):
        checkpoint.save(tmp_path, {"step": 2}, {})
    assert checkpoint.load(tmp_path, {})["step"] == 1


def test_the_rate_rises_to_its_peak_and_falls_to_nothing():
    rates = [training.schedule(part, 0.1) for part in np.linspace(0, 1, 101)]
    assert max(rates) == rates[10] == 1
    assert rates[-1] == pytest.approx(0)
    assert training.schedule(0, 0) == 1
