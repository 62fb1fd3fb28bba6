"""Frames come as masks, photographs or videos, and tell how they moved."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from flights.test_motion import MOTION, gap, seen, streets
from worlds.models import brightness_model
from worlds.turned import save_turned

from roadgeo.errors import MaskError, PhotographError
from roadgeo.evaluation.demo import PHOTO
from roadgeo.flights import frames
from roadgeo.flights.frames import FrameOptions, read_frames, read_stills
from roadgeo.running.options import ReadOptions
from roadgeo.sources.masks import read_mask


def shift(dx: float, dy: float) -> np.ndarray:
    return np.array([[1.0, 0, dx], [0, 1, dy], [0, 0, 1]])


@pytest.fixture
def model(tmp_path: Path) -> FrameOptions:
    """Frames of half a metre, and a network that takes what is light for road."""
    path = brightness_model(tmp_path / "light.onnx", props={"resolution": 50})
    return FrameOptions(ReadOptions(segmenter=str(path)), gsd_m=(0.4, 0.625))


@pytest.fixture
def photographs(tmp_path: Path) -> list[str]:
    """Two cuts of a photograph: the second begins 40 pixels to the right of the first and 24 below."""
    picture = cv2.imread(str(PHOTO))
    for k, (left, top) in enumerate([(300, 200), (340, 224)]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture[top : top + 300, left : left + 400])
    return [str(tmp_path / "0.png"), str(tmp_path / "1.png")]


def test_in_photographs_roads_are_found_and_they_tell_the_motion(model: FrameOptions, photographs: list[str]) -> None:
    first, second = read_frames(photographs, model)
    light = cv2.imread(photographs[0]).mean(axis=2)
    assert first.mask.roads[light > 150].mean() > 0.95
    assert first.mask.roads[light < 105].mean() < 0.05
    assert first.motion is None
    assert gap(second.motion, shift(40.0, 24.0)) < 1.0
    assert (second.name, second.time_s, second.motion_px) == ("1.png", 1.0, 1.5)


def test_where_the_scale_is_not_known_one_serves_all(model: FrameOptions, photographs: list[str]) -> None:
    frames = list(read_frames(photographs, replace(model, gsd_m=None)))
    assert [frame.mask.roads.shape for frame in frames] == [(300, 400)] * 2
    assert all(frame.mask.roads.any() for frame in frames)


def test_a_photograph_without_roads_is_a_frame_of_the_flight(model: FrameOptions, tmp_path: Path) -> None:
    path = tmp_path / "sea.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(20, 100, (300, 400, 3)).astype(np.uint8))
    (frame,) = read_frames([str(path)], replace(model, reading=replace(model.reading, segment="always")))
    assert frame.mask.roads.shape == (300, 400)
    assert not frame.mask.roads.any()


def test_stills_keep_their_picture(model: FrameOptions, photographs: list[str], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), streets())
    ((_, grey),) = read_stills(photographs[:1], model)
    ((_, none),) = read_stills([str(tmp_path / "mask.png")], model)
    expected = cv2.imread(photographs[0], cv2.IMREAD_GRAYSCALE)  # libpng rounds otherwise
    assert np.abs(grey.astype(int) - expected).max() <= 1
    assert none is None


@pytest.mark.parametrize("kind", ["png", "tif"])
def test_frames_are_upright(model: FrameOptions, photographs: list[str], tmp_path: Path, kind: str) -> None:
    turned = [
        str(save_turned(tmp_path / f"{name}.{kind}", cv2.imread(path)[..., ::-1].copy(), orientation))
        for name, path, orientation in zip("ab", photographs, (6, 3), strict=True)
    ]
    blank = save_turned(tmp_path / f"blank.{kind}", np.zeros((300, 400), np.uint8), 8)
    first, second, third = read_frames([*turned, str(blank)], model)
    for frame, path in zip((first, second), photographs, strict=True):
        (expected,) = read_frames([path], model)
        np.testing.assert_array_equal(frame.mask.roads, expected.mask.roads)
    assert gap(second.motion, shift(40.0, 24.0)) < 1.0
    assert third.mask.shape == (300, 400)


def test_messages_about_a_frame_of_a_video_name_the_frame(
    model: FrameOptions, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Not the file in a temporary folder that it is read from."""
    picture = cv2.imread(str(PHOTO))[200:500, 300:700]
    picture[:, 300:] = 255
    video = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 1.0, (400, 300))
    video.write(picture)
    video.release()
    list(read_frames([str(tmp_path / "a.avi")], model))
    assert "a_000000: plain margins are not observed" in caplog.messages[0]


def test_photographs_are_refused_where_masks_are_meant(photographs: list[str]) -> None:
    with pytest.raises(PhotographError):
        list(read_frames(photographs, FrameOptions(ReadOptions(segment="never"))))


@pytest.fixture
def masks(tmp_path: Path) -> list[str]:
    """Masks of a flight: the second moved by MOTION, the third of another size, the fourth without any road."""
    first = streets()
    for k, mask in enumerate([first, seen(first, MOTION), first[:200], np.zeros((200, 320), np.uint8)]):
        cv2.imwrite(str(tmp_path / f"m{k}.png"), mask)
    return [str(tmp_path / f"m{k}.png") for k in range(4)]


def test_masks_tell_the_motion_where_they_can(masks: list[str]) -> None:
    frames = list(read_frames(masks))
    assert gap(frames[1].motion, MOTION) < 12.0
    assert frames[1].motion_px == 12.0
    assert frames[2].motion is None
    assert not frames[3].mask.roads.any()
    assert frames[3].motion is None


def test_the_motion_that_is_given_counts(masks: list[str]) -> None:
    """It goes by the frame's name, with or without its ending."""
    given = {"m1.png": MOTION, "m2": shift(1.0, 2.0)}
    frames = list(read_frames(masks, FrameOptions(motion=given, motion_px=3.0)))
    assert np.array_equal(frames[1].motion, MOTION)
    assert np.array_equal(frames[2].motion, given["m2"])
    assert frames[3].motion is None
    assert {frame.motion_px for frame in frames} == {3.0}


def test_what_is_no_frame_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(MaskError, match=r"a\.png"):
        list(read_frames([str(tmp_path / "a.png")]))


def test_what_is_no_video_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(MaskError, match="no video that OpenCV reads; give its frames as images"):
        list(read_frames([str(tmp_path / "a.mp4")]))


class Recording:
    """Stands for a video of OpenCV's: frames at times, seconds; the rate that it states is another."""

    def __init__(self, times: list[float], **stated: float) -> None:
        self.times, self.at = times, -1
        self.stated = {getattr(cv2, f"CAP_PROP_{name.upper()}"): value for name, value in stated.items()}

    def grab(self) -> bool:
        self.at += 1
        return self.at < len(self.times)

    def get(self, what: int) -> float:
        if what == cv2.CAP_PROP_POS_MSEC:
            return 1000.0 * self.times[self.at]
        return self.stated.get(what, 10.0 if what == cv2.CAP_PROP_FPS else 0.0)

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((64, 64, 3), np.uint8)

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def release(self) -> None:
        pass


def test_frames_of_videos_have_their_own_times_and_files_follow_one_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = {"DJI_1.MP4": [0.0, 0.2, 0.4, 3.0, 3.1], "DJI_2.MP4": [0.0, 1.5], "DJI_10.MP4": [0.0, 2.0]}
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: Recording(times[Path(path).name]))
    for name in times:
        (tmp_path / name).touch()
    cv2.imwrite(str(tmp_path / "DJI_11.png"), np.zeros((64, 64), np.uint8))
    read = [(frame.name, round(frame.time_s, 3)) for frame in read_frames([str(tmp_path)])]
    assert read == [
        *(("DJI_1_000000", 0.0), ("DJI_1_000003", 3.0)),
        *(("DJI_2_000000", 3.2), ("DJI_2_000001", 4.7)),
        *(("DJI_10_000000", 4.8), ("DJI_10_000001", 6.8), ("DJI_11.png", 6.9)),
    ]


@pytest.mark.parametrize(
    ("times", "rate", "right", "message"),
    [
        ([0.0, 0.5, 1.0, 0.0, 0.5, 1.0], 2.0, [0.0, 0.5, 1.0, 1.5, 2.0, 2.5], "fall back by 1.0 s"),  # joined by cat
        ([0.0, 0.5, 1.0, 0.3, 0.8], 2.0, [0.0, 0.5, 1.0, 1.5, 2.0], "fall back by 0.7 s"),  # a link that was cut
        ([95442.7, 95443.2, 0.0, 0.5], 2.0, [95442.7, 95443.2, 95443.7, 95444.2], "go on from 95443.7"),  # 33 bits
        ([0.0, 0.5, 95000.0, 95000.5], 2.0, [0.0, 0.5, 1.0, 1.5], "jump ahead by 94999.5 s"),
        ([0.0, 0.5, 60.0], 2.0, [0.0, 0.5, 60.0], ""),  # a gap
        ([0.0, 0.0, 0.0], 4.0, [0.0, 0.25, 0.5], ""),  # a stream without times
        ([0.0, 0.0, 0.0], 90_000.0, [0.0, 0.04, 0.08], ""),  # and with no rate that makes sense
        ([0.0, 0.5, 0.5, 1.0], 2.0, [0.0, 0.5, 0.5, 1.0], ""),
    ],
)
def test_times_of_a_video_go_on_and_no_frame_is_lost(
    times: list[float], rate: float, right: list[float], message: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: Recording(times, fps=rate))
    (tmp_path / "a.ts").touch()
    read = [round(frame.time_s, 3) for frame in read_frames([str(tmp_path / "a.ts")], FrameOptions(every_s=0.0))]
    assert read == sorted(read)
    assert read[:3] == right[:3]
    assert len(read) == len(right)
    assert message in caplog.text


@pytest.mark.parametrize(("stated", "is_cut"), [(0, False), (12, False), (12.5, False), (20, True), (-9e15, False)])
def test_a_video_that_ends_too_early_is_mentioned(
    stated: float, is_cut: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: Recording([0.5 * k for k in range(12)], frame_count=stated))
    (tmp_path / "a.avi").touch()
    assert len(list(read_frames([str(tmp_path / "a.avi")], FrameOptions(every_s=0.0)))) == 12
    assert ("ends after 12 of the 20 frames" in caplog.text) == is_cut


STRETCHED = [
    ({"sar_num": 4.0, "sar_den": 3.0}, (64, 85)),
    ({"sar_num": 8.0, "sar_den": 9.0}, (72, 64)),
    ({"sar_num": 4.0, "sar_den": 3.0, "orientation_meta": 90.0, "orientation_auto": 1.0}, (85, 64)),
    ({"sar_num": 0.0, "sar_den": 1.0}, (64, 64)),
    ({"sar_num": 0.0, "sar_den": 0.0}, (64, 64)),
]


@pytest.mark.parametrize(("stated", "shape"), STRETCHED)
def test_pixels_of_a_video_are_as_wide_as_its_container_says(
    stated: dict[str, float], shape: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: Recording([0.0], **stated))
    (tmp_path / "a.mov").touch()
    (frame,) = read_frames([str(tmp_path / "a.mov")])
    assert frame.mask.shape == shape
    assert [64 * each for each in frame.stretch[::-1]] == pytest.approx(shape, abs=0.5)
    (frame,) = read_frames([str(tmp_path / "a.mov")], FrameOptions(aspect=2.0))
    assert frame.mask.shape == (64, 128)


@pytest.mark.parametrize("kind", ["mask", "photograph"])
@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_pixels_of_images_are_as_wide_as_their_resolution_says(
    kind: str, suffix: str, model: FrameOptions, photographs: list[str], tmp_path: Path
) -> None:
    picture = cv2.imread(photographs[0])[..., ::-1] if kind == "photograph" else streets()
    squeezed = cv2.resize(picture, None, fx=0.5, fy=1.0, interpolation=cv2.INTER_AREA)
    PIL.Image.fromarray(squeezed).save(tmp_path / f"a.{suffix}", dpi=(100, 200), quality=95)
    (frame,) = read_frames([str(tmp_path / f"a.{suffix}")], model)
    assert frame.mask.shape == picture.shape[:2]
    PIL.Image.fromarray(squeezed).save(tmp_path / f"b.{suffix}", dpi=(100, 200), quality=95)
    given = replace(model, motion={f"b.{suffix}": shift(5.0, 0.0)})
    _, second = read_frames([str(tmp_path / f"{name}.{suffix}") for name in "ab"], given)
    assert second.motion[0, 2] == pytest.approx(10.0)  # pixels of the file are twice as wide


def save_taken(path: Path, taken: str | None, part: str = "") -> None:
    """Write a picture that was taken at a time, by EXIF."""
    exif = PIL.Image.Exif()
    if taken is not None:
        exif[0x8769] = {0x9003: taken, **({0x9291: part} if part else {})}
    PIL.Image.fromarray(streets()).save(path, exif=exif)


@pytest.mark.parametrize("suffix", ["jpg", "webp", "png"])
def test_images_have_the_times_of_exif_where_all_do(
    suffix: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = [tmp_path / f"DSC_{name}.{suffix}" for name in ("9998", "9999", "0001", "0002", "0003")]
    stamps = [("58", "25"), ("59", "5"), ("00", ""), ("00", ""), ("00", "")]
    for name, (second, part) in zip(names, stamps, strict=True):
        save_taken(name, f"2024:05:01 09:{30 + (second == '00')}:{second}", part)
    read = list(read_frames([str(tmp_path)]))
    assert [frame.name for frame in read] == [name.name for name in names]
    assert [frame.time_s for frame in read] == pytest.approx([0.0, 1.25, 1.75, 1.75 + 1 / 3, 1.75 + 2 / 3], abs=1e-3)
    assert "in the order of their times" in caplog.text
    told = read_frames([str(tmp_path)], FrameOptions(interval_s=2.0))
    assert [frame.time_s for frame in told] == [0.0, 2.0, 4.0, 6.0, 8.0]
    save_taken(names[1], None)
    caplog.clear()
    assert [frame.time_s for frame in read_frames([str(tmp_path)])] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert "taken to be 1 s apart" in caplog.text


NAMED = {
    "seconds": (["9.0", "10.0", "10.5", "12.25", "12.5"], [0.0, 1.0, 1.5, 3.25, 3.5]),
    "before and after": (["t=-1.5s", "t=-0.25s", "t=2.0s"], [0.0, 1.25, 3.5]),
    "with words": (["frame_000123.45s", "frame_000124.00s", "frame_000126.5s"], [0.0, 0.55, 3.05]),
    "since 1970": (["1699999999.123", "1699999999.456", "1700000001.5"], [0.0, 0.333, 2.377]),
    "milliseconds": (["1699999999123", "1699999999623", "1700000001123"], [0.0, 0.5, 2.0]),
    "nanoseconds": (["cam0_1403636579763555584", "cam0_1403636579813555456"], [0.0, 0.05]),
    "dates": (["20240611_235958", "20240611_235959", "20240612_000001"], [0.0, 1.0, 3.0]),
    "dates and numbers": ([f"DJI_2024061110450{k}_000{n}_V" for n, k in enumerate("1337")], [0.0, 2.0, 2.5, 6.0]),
    "dates as ISO has them": (["2024-06-11T10-45-01.250", "2024-06-11T10-45-03.000"], [0.0, 1.75]),
    "dates of players": ([f"vlcsnap-2024-05-01-09h30m0{time}" for time in ("0s500", "1s250")], [0.0, 0.75]),
    "dates of phones": (["PXL_20240501_093000250", "PXL_20240501_093001000"], [0.0, 0.75]),
    "dates of screens": (["Shot 2024-05-01 at 09.30.00", "Shot 2024-05-01 at 09.30.05"], [0.0, 5.0]),
    "times of day": (["shot_00_01_02.500", "shot_00_01_03.250", "shot_00_02_00.000"], [0.0, 0.75, 57.5]),
    "times of day in letters": (["a-00h01m59s500", "a-00h02m00s250"], [0.0, 0.75]),
    "decimal commas": (["t_9,5", "t_10,25", "t_10,5"], [0.0, 0.75, 1.0]),
    "since 1970, and a camera": (["1699999999.123456_left", "1699999999.623456_left"], [0.0, 0.5]),
    "seconds and nanoseconds": (["a_1699999999_123456789", "a_1699999999_623456789"], [0.0, 0.5]),
    "numbers and seconds": (["frame_0001_12.5", "frame_0002_13.25"], [0.0, 0.75]),
    "clocks that restart": (["a_0.5", "a_1.5", "b_0.5", "b_1.5"], [0.0, 1.0, 2.0, 3.0]),
    "clocks of two cameras": (["cam1_0.5", "cam1_1.5", "cam2_0.5"], [0.0, 1.0, 2.0]),
    "no times of day": (["shot_00_75_02.500", "shot_00_76_00.000"], [0.0, 1.0]),
    "numbers": (["frame_1", "frame_2", "frame_7"], [0.0, 1.0, 2.0]),
    "one has none": (["1.5", "2.0", "last"], [0.0, 1.0, 2.0]),
    "no dates": (["20241399_104501", "20241399_104509"], [0.0, 1.0]),
}


@pytest.mark.parametrize("kind", NAMED)
@pytest.mark.parametrize("suffix", ["png", "jpg", "TIF"])
def test_images_have_the_times_of_their_names_where_all_do(
    kind: str, suffix: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names, times = NAMED[kind]
    for name in names:
        PIL.Image.fromarray(streets()).save(tmp_path / f"{name}.{suffix}")
    read = list(read_frames([str(tmp_path)]))
    assert [frame.name for frame in read] == [f"{name}.{suffix}" for name in names]
    assert [frame.time_s for frame in read] == pytest.approx(times, abs=1e-3)
    assert ("stand in their names" in caplog.text) == ("1 s apart" not in caplog.text)


def test_a_video_is_known_by_its_content_too(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, (320, 240))
    for _ in range(3):
        writer.write(np.full((240, 320, 3), 255, np.uint8))
    writer.release()
    (tmp_path / "a.avi").rename(tmp_path / "REC00001.PIO")
    assert len(list(read_frames([str(tmp_path / "REC00001.PIO")], FrameOptions(every_s=0.0)))) == 3
    (tmp_path / "list.PIO").write_text("#EXTM3U\n#EXTINF:1,\nREC00001.PIO\n")
    with pytest.raises(MaskError, match="not a raster"):
        list(read_frames([str(tmp_path / "list.PIO")]))


@pytest.mark.parametrize("suffix", ["tif", "gif", "png"])
def test_pages_and_animations_are_frames(tmp_path: Path, suffix: str) -> None:
    shown = [streets(), streets()[::-1].copy(), streets()[:, ::-1].copy()]
    first, *others = map(PIL.Image.fromarray, shown)
    first.save(tmp_path / f"a.{suffix}", save_all=True, append_images=others, duration=1000)
    read = list(read_frames([str(tmp_path / f"a.{suffix}")]))
    names = [f"a_page{k + 1}" if suffix == "tif" else f"a_{k:06d}" for k in range(3)]
    assert [(frame.name, frame.time_s) for frame in read] == [(name, float(k)) for k, name in enumerate(names)]
    for frame, picture in zip(read, shown, strict=True):
        np.testing.assert_array_equal(frame.mask.roads, picture > 127)


@pytest.mark.parametrize("suffix", ["gif", "png", "avi"])
def test_a_video_that_is_shorter_than_a_step_is_mentioned(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / f"a.{suffix}"
    if suffix == "avi":
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240))
        for _ in range(3):
            writer.write(np.full((240, 320, 3), 255, np.uint8))
        writer.release()
    else:
        first, *others = map(PIL.Image.fromarray, [streets(), streets()[::-1].copy(), streets()[:, ::-1].copy()])
        first.save(path, save_all=True, append_images=others, duration=100)
    assert len(list(read_frames([str(path)]))) == 1
    assert "one frame of 3 is taken; --every SECONDS takes more" in caplog.text
    caplog.clear()
    assert len(list(read_frames([str(path)], FrameOptions(every_s=0.0)))) == 3
    assert "--every" not in caplog.text


def test_names_in_the_order_of_text_are_mentioned(masks: list[str], caplog: pytest.LogCaptureFixture) -> None:
    renamed = [str(Path(masks[0]).with_name(name)) for name in ("n1.png", "n10.png", "n2.png")]
    for path, name in zip(masks, renamed, strict=False):
        Path(path).rename(name)
    assert [frame.name for frame in read_frames(renamed)] == ["n1.png", "n10.png", "n2.png"]
    assert "give their folder" in caplog.text


@pytest.fixture
def white(photographs: list[str], tmp_path: Path) -> str:
    """A photograph that is white but for a corner."""
    picture = np.full_like(cv2.imread(photographs[0]), 255)
    picture[:40, :120] = 0
    cv2.imwrite(str(tmp_path / "white.png"), picture)
    return str(tmp_path / "white.png")


def test_a_white_frame_among_photographs_is_no_mask(
    model: FrameOptions, photographs: list[str], white: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []
    monkeypatch.setattr(frames, "read_mask", lambda path, **_: taken.append(path) or read_mask(path))
    assert len(list(read_frames([photographs[0], white, white, photographs[1]], model))) == 4
    assert taken == [photographs[0]]  # which was found to be none


@pytest.mark.parametrize("place", [0, 1, 2])
def test_nor_is_one_of_an_archive_wherever_it_comes(
    model: FrameOptions, photographs: list[str], white: str, place: int
) -> None:
    assert read_mask(white).roads[:40, :120].all()
    given = [*photographs[:place], white, *photographs[place:2]]
    read = list(read_stills(given, model))
    assert [frame.name for frame, _ in read] == [Path(path).name for path in given]
    assert not read[place][0].mask.roads[:40, :120].any()
    assert all(grey is not None for k, (_, grey) in enumerate(read) if k != place)
