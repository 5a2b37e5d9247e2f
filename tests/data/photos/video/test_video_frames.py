"""A video becomes a set of photos: its sharp frames, named by time."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.data.photos.video.video_frames import CHOSEN, VIDEO_FRAMES, VideoReading
from biresnerf.errors import InputError, Interrupted
from biresnerf.progress import told_before_the_run
from tests.data.photos.video.filmed import HEIGHT, RATE, WIDTH, film, wall
from tests.data.scenes import assert_complete, nerfstudio_scene, save, write_image

FRAMES = 150
SOFT = [i % 4 != 1 for i in range(FRAMES)]
# The camera stands still for a third of the time, and is slow after that.
AT_PX = np.cumsum(np.repeat([3.0, 0.0, 1.0], FRAMES // 3))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    film(path, AT_PX, SOFT)
    return path


@pytest.fixture
def clip(filmed: Path, tmp_path: Path) -> Path:
    (tmp_path / "set").mkdir()
    return Path(shutil.copy2(filmed, tmp_path / "set/walk.mp4"))


def numbers(names: tuple[str, ...]) -> list[int]:
    """Which frames these are, by the times in their names."""
    stems = [Path(name).stem for name in names]
    return [round((60 * int(stem[:2]) + int(stem[3:5]) + int(stem[6:]) / 1000) * RATE) for stem in stems]


def test_the_chosen_frames_are_the_sharp_ones_and_cover_the_motion(clip):
    dataset = read_dataset(clip.parent, videos=VideoReading(12))
    assert dataset.names[0].startswith("video_frames/walk_mp4/00m00s")
    chosen = numbers(dataset.names)
    assert len(chosen) == 12
    assert not any(SOFT[number] for number in chosen)
    assert np.diff(AT_PX[chosen]).max() <= 2 * AT_PX[-1] / 12
    assert sum(FRAMES // 3 + 3 < number < 2 * FRAMES // 3 - 3 for number in chosen) <= 1
    (note,) = [line for line in dataset.warnings if "walk.mp4" in line]
    assert "12 frames" in note


@pytest.mark.parametrize("pixels", ["yuv420p", "yuv420p10le"])  # phones film in 10 bits, too
def test_a_frame_is_the_picture_of_its_time(tmp_path, pixels):
    film(tmp_path / "walk.mp4", AT_PX, SOFT, pixels=pixels)
    dataset = read_dataset(tmp_path / "walk.mp4", videos=VideoReading(12))
    images, scene = load_images(dataset), np.asarray(wall(int(AT_PX.max()) + WIDTH + 1), dtype=float)
    assert (images.widths == WIDTH).all()
    for index, number in enumerate(numbers(dataset.names)):
        left = round(AT_PX[number])
        true = scene[:, left : left + WIDTH]
        assert np.abs(images.image(index) - true).mean() < 12, number  # H.264's losses


@pytest.mark.parametrize(
    ("turn", "size"), [(90, (HEIGHT, WIDTH)), (180, (WIDTH, HEIGHT)), (270, (HEIGHT, WIDTH))]
)
def test_a_video_that_is_marked_as_turned_gives_upright_frames(clip, turn, size):
    upright = load_images(read_dataset(clip, videos=VideoReading(5)))
    other = clip.parent / "turned"
    other.mkdir()
    command = [get_ffmpeg_exe(), "-v", "error", "-display_rotation", str(turn), "-i", str(clip), "-c", "copy"]
    subprocess.run([*command, str(other / "t.mp4")], check=True)
    turned = load_images(read_dataset(other, videos=VideoReading(5)))
    assert (turned.widths[0], turned.heights[0]) == size
    # FFmpeg counts against the clock.
    back = np.rot90(upright.image(0).astype(float), turn // 90)
    assert np.abs(turned.image(0) - back).mean() < 1


def test_frames_are_written_once_and_again_where_more_are_asked_for(clip):
    first = read_dataset(clip.parent, videos=VideoReading(6))
    folder = clip.parent / VIDEO_FRAMES / "walk_mp4"
    written = folder.stat().st_ino
    assert read_dataset(clip.parent).names == first.names
    assert read_dataset(clip.parent, videos=VideoReading(6)).names == first.names
    assert folder.stat().st_ino == written
    assert len(read_dataset(clip.parent, videos=VideoReading(9))) == 9
    told = json.loads((folder / CHOSEN).read_text())
    assert len(told["frames"]) == 9
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        [CHOSEN, *(f["file"] for f in told["frames"])]
    )
    clip.write_bytes(clip.read_bytes() + bytes(9))
    assert len(read_dataset(clip.parent)) > 9  # another file: its frames are chosen anew


def test_frames_without_their_video_are_photos_of_the_same_names(clip):
    names = read_dataset(clip.parent, videos=VideoReading(6)).names
    clip.unlink()
    assert read_dataset(clip.parent).names == names


def test_two_videos_beside_photos_share_the_count(clip):
    for i in range(3):
        write_image(clip.parent / f"{i}.jpg", i)
    shutil.copy2(clip, clip.parent / "walk.mov")
    names = read_dataset(clip.parent, videos=VideoReading(8)).names
    assert names[:3] == ("0.jpg", "1.jpg", "2.jpg")
    assert [sum(f"walk_{kind}/" in name for name in names) for kind in ("mp4", "mov")] == [4, 4]


def test_videos_of_live_photos_and_beside_poses_or_their_own_frames_are_not_read(clip):
    write_image(clip.parent / "WALK.jpg", 0)
    for i in range(2):
        write_image(clip.parent / f"{i}.jpg", i)
    assert read_dataset(clip.parent).names == ("0.jpg", "1.jpg", "WALK.jpg")
    (clip.parent / "images").mkdir()
    for path in clip.parent.glob("*.jpg"):
        path.rename(clip.parent / "images" / path.name)
    dataset = read_dataset(clip.parent)
    assert len(dataset) == 3
    assert any("walk.mp4" in line and "left out" in line for line in dataset.warnings)
    posed = clip.parent / "posed"
    posed.mkdir()
    save(posed, nerfstudio_scene(posed))
    shutil.copy2(clip, posed / "v.mp4")
    assert len(read_dataset(posed)) == 4
    assert not list(clip.parent.rglob(VIDEO_FRAMES))


def test_what_is_no_video_is_refused_by_its_name(clip):
    clip.write_bytes(b"\0\0\0\x18ftypmp42" + bytes(500))
    with pytest.raises(InputError) as caught:
        read_dataset(clip.parent)
    assert_complete(caught.value, "video_unreadable", "walk.mp4")
    assert str(clip.parent) not in str(caught.value)
    assert not (clip.parent / VIDEO_FRAMES).exists()


def test_a_video_that_is_a_list_of_other_files_opens_none_of_them(clip):
    secret = clip.parent / "secret.mp4"
    clip.rename(secret)
    clip.write_text(f"#EXTM3U\n#EXTINF:9,\nfile://{secret}\n")
    with pytest.raises(InputError) as caught:
        read_dataset(clip)
    assert caught.value.code == "video_unreadable"
    clip.write_text("ffconcat version 1.0\nfile secret.mp4\n")
    with pytest.raises(InputError):
        read_dataset(clip)


def test_a_video_that_is_cut_off_gives_the_frames_before_that(clip):
    whole = subprocess.run(
        [get_ffmpeg_exe(), "-v", "error", "-i", clip, "-c", "copy", "-movflags", "+frag_keyframe", "-f", "mp4",
         "-g", "10", clip.with_name("f.mp4")], check=True,
    )  # fmt: skip
    assert whole.returncode == 0
    content = clip.with_name("f.mp4").read_bytes()
    clip.with_name("f.mp4").unlink()
    clip.write_bytes(content[: len(content) // 2])
    dataset = read_dataset(clip, videos=VideoReading(5))
    assert len(dataset) == 5
    assert max(numbers(dataset.names)) < FRAMES


def test_choosing_frames_can_be_stopped_and_leaves_nothing(clip):
    said: list[str] = []
    watch = told_before_the_run(lambda progress: said.append(progress.message), lambda: len(said) > 1)
    with pytest.raises(Interrupted):
        read_dataset(clip, videos=VideoReading(5, watch))
    assert said == ["looking for sharp frames of walk.mp4", "writing frames of walk.mp4"]
    assert list((clip.parent / VIDEO_FRAMES).iterdir()) == []


def test_a_folder_that_cannot_be_written_to_is_named(clip):
    (clip.parent / VIDEO_FRAMES).write_text("a file where the folder would be")
    with pytest.raises(InputError) as caught:
        read_dataset(clip)
    assert_complete(caught.value, "video_frames_not_written", VIDEO_FRAMES)


def test_inspect_and_refine_take_the_count(clip):
    command = [
        sys.executable,
        "-m",
        "biresnerf.command_line",
        "inspect",
        str(clip),
        "--json",
        "--set",
        "video_frames=7",
    ]
    told = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert (told["images"], told["format"]) == (7, "images")
    frames = sorted((clip.parent / VIDEO_FRAMES / "walk_mp4").glob("*.jpg"))
    assert len(frames) == 7
    with Image.open(frames[0]) as first:
        assert first.size == (WIDTH, HEIGHT)
