"""Where frames enter: masks, photographs or a video become road masks with times, one after another.

Memory holds two frames at a time. The motion of a frame comes from a file, from the photographs, or from the masks.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._text import log_of
from roadgeo.errors import MaskError, PhotographError
from roadgeo.flights.motion import Odometer, between_images
from roadgeo.flights.strips import place_strips
from roadgeo.flights.tracker import FlightFrame, Tracked, TrackOptions, follow
from roadgeo.geometry.georeference import stretch_of
from roadgeo.geometry.mask import RoadMask
from roadgeo.reference.reference import Reference
from roadgeo.running.options import ReadOptions
from roadgeo.running.photographs import load_model
from roadgeo.running.tasks import SUFFIXES, VIDEOS, find_masks, in_natural_order
from roadgeo.running.variants import resampled
from roadgeo.sources.exif import read_time
from roadgeo.sources.georeference import read_stated
from roadgeo.sources.masks import read_mask
from roadgeo.storage.files import writing
from roadgeo.storage.rasters import count_frames, is_raster, pages_of

__all__ = ["FrameOptions", "follow_frames", "read_frames", "read_stills"]

_LOG = log_of(__name__)

#: Frames a second of a video that states none, or none that makes sense.
_USUAL_RATE = 25.0
_LONG_S = 3600.0  # no flight is filmed with a gap of this length: another clock begins
_HEAD_BYTES = 4096
#: Times in names: a date; seconds since 1970, with digits of a fraction, or milli-, micro- or nanoseconds; a time of
#: day, or seconds, with a fraction.
_TIMES = (
    re.compile(
        r"(?<!\d)((?:19|20)\d\d[-_.]?\d\d[-_.]?\d\d(?: at |[-_T ])?\d\d[-_:.h]?\d\d[-_:.m]?\d\d)"
        r"(?:(?:[.,s]|(?=(?:\d{3}){1,3}(?!\d)))(\d{1,9}))?(?!\d)"
    ),
    re.compile(r"(?<![\d.])(1\d{9})[._]?(\d{3}|\d{6}|\d{9})?(?![\d.,])"),
    re.compile(r"(?<!\d)(\d\d[-_:.h]\d\d[-_:.m]\d\d)[.,s](\d{1,9})$"),
    re.compile(r"^(?:.*[^\d.,-])?(-?\d{1,10})[.,](\d{1,9})(?:s|sec|seconds)?$"),
)
_WHOLE_SHARE = 0.95  # of the frames that a container states: some only estimate their number


@dataclass(frozen=True)
class FrameOptions:
    """How frames are read.

    Attributes
    ----------
    reading : ReadOptions
        How each is read; roads of photographs are found by one network.
    gsd_m : (low, high) or None
        Metres per pixel, where that is known: photographs are shown to the network at its own.
    motion : mapping of frame name to (3, 3), or None
        Pixel of a frame to pixel of the one before.
    motion_px : float or None
        Standard deviation of a corner moved by the motion. None: the usual one of its source.
    every_s : float
        Time between the frames taken of a video; 0: all.
    interval_s : float or None
        Time between images. None: as EXIF or names state it, where all of them have times, else a second.
    aspect : float or None
        How many times a pixel is as wide as high. None: as each file states it, else square.
    recursive : bool
        Whether folders stand for the images in all folders within them, too.
    """

    reading: ReadOptions = field(default_factory=ReadOptions)
    gsd_m: tuple[float, float] | None = None
    motion: Mapping[str, FloatArray] | None = None
    motion_px: float | None = None
    every_s: float = 1.0
    interval_s: float | None = None
    aspect: float | None = None
    recursive: bool = False


class _FrameFile(NamedTuple):
    """A frame's file, its name, its time, and how many times its pixels are as wide as high."""

    path: str
    name: str
    time_s: float
    aspect: float
    stays: bool = True

    @property
    def stretch(self) -> tuple[float, float]:
        """Columns and rows of the frame, whose pixels are square, for each of the file."""
        return max(self.aspect, 1.0), max(1.0 / self.aspect, 1.0)


@dataclass
class _Last:
    """The previous frame, as far as the next one needs it, and whether there was a photograph."""

    mask: RoadMask | None = None
    grey: AnyArray | None = None
    odometer: Odometer = field(default_factory=Odometer)
    scale: float | None = None
    has_photographs: bool = False


def read_frames(arguments: Sequence[str], options: FrameOptions | None = None) -> Iterator[FlightFrame]:
    """Read frames of a flight: files, folders, patterns, or videos, in order.

    Raises
    ------
    MaskError
        One cannot be read, or is neither a mask nor a photograph.
    ModelError
        There is no network to find roads in photographs, or it fails.
    """
    options, last = options or FrameOptions(), _Last()
    with ExitStack() as stack:
        for number, image in enumerate(_images(arguments, options, stack)):
            mask, grey = _read(image, options, last)
            motion, error_px = _motion(image, mask, grey, options, last) if number else (None, 1.5)
            last.mask, last.grey = mask, grey
            error_px = options.motion_px or error_px
            yield FlightFrame(number, image.name, image.time_s, mask, motion, error_px, image.stretch)


def read_stills(
    arguments: Sequence[str], options: FrameOptions | None = None
) -> Iterator[tuple[FlightFrame, AnyArray | None]]:
    """Read frames that are in no order: files, folders or patterns; each with its picture in grey where it is one.

    They are of one kind: where one is a photograph, those that came before it were no masks.

    Raises
    ------
    MaskError, ModelError
        As of `read_frames`.
    """
    options, last = options or FrameOptions(), _Last()
    read: list[tuple[_FrameFile, FlightFrame, AnyArray | None]] = []
    with ExitStack() as stack:
        for number, image in enumerate(_images(arguments, options, stack)):
            mask, grey = _read(image, options, last)
            read.append((image, FlightFrame(number, image.name, image.time_s, mask, stretch=image.stretch), grey))
        for image, frame, grey in read:
            if last.has_photographs and grey is None and image.stays and frame.mask.roads.any():
                mask, grey = _read(image, options, last)
                frame = replace(frame, mask=mask)
            yield frame, grey


def follow_frames(
    arguments: Sequence[str],
    reading: FrameOptions,
    references: Sequence[Reference],
    options: TrackOptions,
    unordered: bool = False,
) -> Iterator[tuple[FlightFrame, list[Tracked]]]:
    """Read frames, and follow them; or place those that are in no order. Yield each with the states that it changes.

    Raises
    ------
    MaskError, ModelError
        As of `read_frames`.
    """
    if unordered:
        placed = place_strips(list(read_stills(arguments, reading)), references, options)
        return ((tracked.frame, [tracked]) for tracked in placed)
    return follow(read_frames(arguments, reading), references, options)


def _images(arguments: Sequence[str], options: FrameOptions, stack: ExitStack) -> Iterator[_FrameFile]:
    """Yield frames with their times: each file begins where the one before ended."""
    if len(arguments) > 1 and list(arguments) == sorted(arguments) != sorted(arguments, key=in_natural_order):
        _LOG.warning("frames come in the order of their names as text, frame_10 before frame_2; give their folder")
    paths = find_masks(arguments, options.recursive, SUFFIXES + VIDEOS)
    are_videos = [_is_video(path) for path in paths]
    paths, times = (paths, []) if any(are_videos) else _by_time(paths, options)
    begun_s = 0.0
    for n, path in enumerate(paths):
        if are_videos[n]:
            begun_s = yield from _video(path, options, stack, begun_s)
        else:
            aspect = options.aspect or read_stated(path).aspect or 1.0
            pages, step_s, begun_s = pages_of(path), options.interval_s or 1.0, times[n] if times else begun_s
            for k, page in enumerate(pages, 1):
                name = Path(path).name if len(pages) == 1 else f"{Path(path).stem}_page{k}"
                yield _FrameFile(page, name, begun_s, aspect)
                begun_s += step_s


def _is_video(path: str) -> bool:
    """Whether a file is a video: by its name, or because it is no still picture and OpenCV plays it."""
    suffix, is_file = Path(path).suffix.lower(), Path(path).is_file()
    if suffix in SUFFIXES or not is_file:
        return is_file and count_frames(path) > 1
    with Path(path).open("rb") as file:
        is_text = b"\0" not in file.read(_HEAD_BYTES)  # a list of other files to play, maybe
    return suffix in VIDEOS or (not (is_text or is_raster(path)) and cv2.VideoCapture(path, cv2.CAP_FFMPEG).isOpened())


def _by_time(paths: list[str], options: FrameOptions) -> tuple[list[str], list[float]]:
    """Return images in the order of their times, and their times; none where neither EXIF nor names have all of them.

    Frames of one second are spread over it, where whole ones are given.
    """
    if options.interval_s is not None or len(paths) < 2:
        return paths, []
    times = [time for time in map(read_time, paths) if time is not None]
    if len(times) < len(paths) or len({*times}) == 1:
        times = _named_times(paths)
        if not times:
            said = "not all of them have times, in EXIF or in their names"
            _LOG.warning("images are taken to be 1 s apart: %s; --interval says otherwise", said)
            return paths, []
        _LOG.warning("frames have the times that stand in their names; --interval says otherwise")
    order = sorted(range(len(paths)), key=times.__getitem__)
    if order != [*range(len(paths))]:
        _LOG.warning("frames come in the order of their times, not of their names")
    of_one = Counter(times)
    seconds = [times[k] + times[:k].count(times[k]) / of_one[times[k]] for k in order]
    return [paths[k] for k in order], [time - seconds[0] for time in seconds]


def _named_times(paths: Sequence[str]) -> list[float]:
    """Return the times in the names of images, seconds; none where not all have one.

    Where more than the time varies, as in recordings one after another, it has to rise from name to name.
    """
    for pattern in _TIMES:
        matches = [match for path in paths if (match := pattern.search(Path(path).stem))]
        times = [time for match in matches if (time := _time_of(*match.groups())) is not None]
        rests = {match.string[: match.start(1)] + match.string[match.end() :] for match in matches}
        if len(times) == len(paths) and len({*times}) > 1 and (len(rests) == 1 or times == sorted(times)):
            return times
    return []


def _time_of(whole: str, part: str | None) -> float | None:
    """Return seconds, since midnight of a time of day, or since 1970 of a date; None of a date that there is not."""
    digits = re.sub(r"\D", "", whole)
    if len(digits) == 14 or re.search(r"\d\D", whole):
        with suppress(ValueError):
            moment = datetime.strptime(("19700101" + digits)[-14:], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
            return moment.timestamp() + float(f"0.{part or 0}")
        return None
    return float(f"{whole}.{part or 0}")


def _video(
    path: str, options: FrameOptions, stack: ExitStack, begun_s: float = 0.0
) -> Generator[_FrameFile, None, float]:
    """Take frames of a video that begins at a time; each is a file for as long as it is read. Return when it ends."""
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="roadgeo-"))
    video = cv2.VideoCapture(path)
    stack.callback(video.release)
    if not video.isOpened():
        raise MaskError(f"{path}: no video that OpenCV reads; give its frames as images")
    rate, name = video.get(cv2.CAP_PROP_FPS), Path(path).name
    step_s = 1.0 / rate if 0.01 < rate < 10_000 else 1.0 / _USUAL_RATE
    aspect = options.aspect or _aspect_of(video, name)
    taken, next_s, at_s, shift_s = 0, 0.0, -step_s, 0.0
    for k in range(1 << 31):
        if not video.grab():
            break
        # Frames of phones and links come at no fixed rate; where the container states no time, they do.
        stamp_s = video.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        now_s = stamp_s + shift_s if stamp_s > 0.0 else at_s + step_s
        if k and not -1e-6 < now_s - at_s < _LONG_S:  # two recordings in one file, a link that was cut, a counter's end
            way = "fall back" if now_s < at_s else "jump ahead"
            _LOG.warning(
                "%s: its time stamps %s by %.1f s; its times go on from %.1f s", name, way, abs(now_s - at_s), at_s
            )
            shift_s += at_s + step_s - now_s
            now_s = at_s + step_s
        at_s = now_s
        if at_s + 1e-9 < next_s:
            continue
        next_s = at_s + options.every_s
        good, picture = video.retrieve()
        if not good:
            continue
        target = str(Path(folder) / "frame.png")
        with writing(target):  # OpenCV does not report a full disk
            Path(target).write_bytes(cv2.imencode(".png", picture)[1].tobytes())
        taken += 1
        yield _FrameFile(target, f"{Path(path).stem}_{k:06d}", begun_s + at_s, aspect, stays=False)
    if not taken:
        raise MaskError(f"{path}: no frame of the video can be read; give its frames as images")
    if taken == 1 < k:
        _LOG.warning("%s: lasts %.2g s: one frame of %d is taken; --every SECONDS takes more", name, at_s + step_s, k)
    stated = video.get(cv2.CAP_PROP_FRAME_COUNT)
    if k < _WHOLE_SHARE * stated:
        _LOG.warning("%s: ends after %d of the %d frames that it states: it may be cut off", name, k, stated)
    return begun_s + at_s + step_s


def _aspect_of(video: cv2.VideoCapture, name: str) -> float:
    """Return how many times the pixels of a video are as wide as high, as its container states."""
    aspect = stretch_of(video.get(cv2.CAP_PROP_SAR_NUM), video.get(cv2.CAP_PROP_SAR_DEN)) or 1.0
    if video.get(cv2.CAP_PROP_ORIENTATION_AUTO) and video.get(cv2.CAP_PROP_ORIENTATION_META) % 180:
        aspect = 1.0 / aspect  # OpenCV has turned the frames
    if aspect != 1.0:
        _LOG.warning("%s: a pixel is %.3g times as wide as high, as it states; --aspect 1 says no", name, aspect)
    return aspect


def _read(image: _FrameFile, options: FrameOptions, last: _Last) -> tuple[RoadMask, AnyArray | None]:
    """Read a frame as a mask, and as a grey picture where it is a photograph."""
    reading = options.reading
    # A white or a black frame among photographs is no mask.
    of_photographs = reading.segment == "always" or (reading.segment == "auto" and last.has_photographs)
    try:
        if not of_photographs:
            try:
                mask = read_mask(image.path, band=reading.band, threshold=reading.threshold, name=image.name)
                return _squared(mask, image), None
            except PhotographError:
                if reading.segment == "never":
                    raise
        last.has_photographs = True
        return _segment(image, options, last)
    except PhotographError:
        raise
    except MaskError:
        blank = _blank(image)
        if blank is None:
            raise
        return _squared(blank, image), None


def _squared(mask: RoadMask, image: _FrameFile) -> RoadMask:
    """Return a mask with square pixels."""
    if image.aspect == 1.0:
        return mask
    wide, high = image.stretch
    return resampled(mask, (round(high * mask.shape[0]), round(wide * mask.shape[1]))).mask


def _blank(image: _FrameFile) -> RoadMask | None:
    """Return a mask without any road for a frame of one colour, which a flight may hold; None for any other."""
    from roadgeo.storage.rasters import open_raster

    with suppress(MaskError), open_raster(image.path) as raster:
        if not np.ptp(raster.read(), axis=(1, 2)).any():
            return RoadMask(np.zeros(raster.shape, np.bool_), name=image.name)
    return None


def _segment(image: _FrameFile, options: FrameOptions, last: _Last) -> tuple[RoadMask, AnyArray]:
    """Find the roads in a photograph, at the scale that its pixels have, or that served the first one best.

    Also returns the photograph in grey.
    """
    from roadgeo.sources.segmentation.photograph import open_photograph
    from roadgeo.sources.segmentation.scales import rank_scales, scale_of
    from roadgeo.sources.segmentation.tiling import segment

    reading = options.reading
    network = load_model(reading.segmenter, reading.class_name, reading.threads)
    with open_photograph(image.path, reading.bands, image.name) as opened:
        photograph = opened.stretched(*image.stretch)
        if last.scale is None:
            gsd_m = None if options.gsd_m is None else math.sqrt(math.prod(options.gsd_m))
            scales = rank_scales(photograph, network) if gsd_m is None else [scale_of(gsd_m, network)]
            last.scale = next(iter(scales))
        shape = photograph.height, photograph.width
        probability = segment(photograph, network, last.scale).resized(shape)
        rgb, _ = photograph.read(0.0, 0.0, float(photograph.width), float(photograph.height), shape)
    try:
        mask = probability.mask(probability.threshold if reading.threshold is None else reading.threshold)
    except MaskError:
        mask = RoadMask(np.zeros(shape, np.bool_))
    return replace(mask, name=image.name), np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


def _motion(
    image: _FrameFile, mask: RoadMask, grey: AnyArray | None, options: FrameOptions, last: _Last
) -> tuple[FloatArray | None, float]:
    """Return how a frame moved against the one before, and how far off that may put a corner, pixels."""
    if options.motion is not None:
        matrix = options.motion.get(image.name, options.motion.get(Path(image.name).stem))
        square = np.diag([*image.stretch, 1.0])  # the user knows the motion of pixels as they are stored
        return None if matrix is None else square @ matrix @ np.linalg.inv(square), 1.5
    if last.mask is None or last.mask.shape != mask.shape:
        last.odometer = Odometer()  # another camera: the previous motion does not apply
        return None, 1.5
    if grey is not None and last.grey is not None:
        return between_images(last.grey, grey), 1.5
    return last.odometer.move(last.mask, mask)
