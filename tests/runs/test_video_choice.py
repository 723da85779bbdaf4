"""Which frames of a video are chosen, on frames whose overlap is known."""

import weakref

import cv2
import numpy as np
import pytest
from moving_views import HEIGHT, WIDTH, blurred, views

from jaxsfm.runs.video.choice import FIRST, FROM, TO, choose_frames
from jaxsfm.runs.video.motion import (
    SmallFrame,
    common_area,
    detail_ratio,
    followed_motion,
    matched_motion,
)

PIXEL = 1 / WIDTH


def numbers(frames, overlap):
    return [frame.index for frame in choose_frames(iter(frames), overlap)]


# -- motion and sharpness -------------------------------------------------------------------------


def test_a_motion_is_that_of_the_picture():
    frames = [SmallFrame.of(frame) for frame in views([0, 9, 120])]
    for measure, second, shift in ((followed_motion, 1, 9), (matched_motion, 2, 120)):
        motion = measure(frames[0], frames[second])
        assert motion is not None
        np.testing.assert_allclose(motion[:2, :2], np.eye(2), atol=0.01)
        np.testing.assert_allclose(motion[:2, 2], [-shift, 0], atol=0.7)


def test_no_motion_is_found_where_there_is_nothing_to_follow():
    black = SmallFrame.of(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    noise = [
        np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for i in (0, 1)
    ]
    for first, second in ((black, black), [SmallFrame.of(n) for n in noise]):
        assert followed_motion(first, second) is None
        assert matched_motion(first, second) is None


@pytest.mark.parametrize(
    "turn, scale, shift", [(0, 1, (40, -30)), (30, 1, (5, 9)), (10, 1.7, (-60, 20))]
)
def test_the_common_area_is_that_of_counted_pixels(turn, scale, shift):
    angle = np.radians(turn)
    motion = np.eye(3)
    motion[:2, :2] = scale * np.asarray(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )
    motion[:2, 2] = shift
    grid = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2)

    def part(matrix):
        x, y = (grid @ matrix[:2, :2].T + matrix[:2, 2]).T
        return np.mean((x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT))

    counted = min(part(motion), part(np.linalg.inv(motion)))
    assert common_area(motion, (WIDTH, HEIGHT)) == pytest.approx(counted, abs=0.01)
    back = common_area(np.linalg.inv(motion), (WIDTH, HEIGHT))
    assert back == pytest.approx(counted, abs=0.01)


def test_richer_content_does_not_make_a_frame_sharper_and_blur_makes_it_less_sharp():
    first, second = views([0, 100])
    poor = first.copy()
    poor[:, :90] = 128  # what the second frame does not show
    shift = np.asarray([[1.0, 0, -100], [0, 1, 0], [0, 0, 1]])
    here = SmallFrame.of(poor)
    assert detail_ratio(here, SmallFrame.of(second), shift) == pytest.approx(1, abs=0.05)
    assert detail_ratio(here, SmallFrame.of(blurred(second)), shift) < 0.6


# -- the choice -----------------------------------------------------------------------------------


@pytest.mark.parametrize("overlap, speed", [(0.7, 10), (0.9, 5)])
def test_neighbours_have_about_the_overlap_that_was_asked_for(overlap, speed):
    places = list(range(0, 500, speed))
    chosen = numbers(views(places), overlap)
    steps = np.diff(np.asarray(places)[chosen]) * PIXEL / (1 - overlap)
    slack = (speed + 2) * PIXEL / (1 - overlap)
    assert (steps > FROM - slack).all() and (steps < TO + slack).all()
    assert places[chosen[0]] * PIXEL <= FIRST * (1 - overlap)
    assert (500 - places[chosen[-1]]) * PIXEL < 2 * (1 - overlap)


def test_a_frame_says_how_far_the_camera_has_moved_since_the_frame_before():
    places = np.arange(0, 300, 6)
    chosen = list(choose_frames(iter(views(places)), 0.8))
    assert chosen[0].motion is None
    for before, frame in zip(chosen, chosen[1:], strict=False):
        assert frame.motion is not None
        moved = places[frame.index] - places[before.index]
        np.testing.assert_allclose(frame.motion[:2, 2], [-moved, 0], atol=1.5)


def test_the_way_counts_and_not_the_time():
    way = 480
    slow = numbers(views(range(0, way, 5)), 0.8)
    fast = numbers(views(range(0, way, 15)), 0.8)
    waits = [x for x in range(0, way, 15) for _ in range(12 if x == 300 else 1)]
    assert abs(len(slow) - len(fast)) <= 1
    assert abs(len(numbers(views(waits), 0.8)) - len(fast)) <= 1


def test_a_camera_that_stands_still_gives_one_frame():
    rng = np.random.default_rng(0)
    (view,) = views([0])
    still = [cv2.add(view, rng.integers(0, 6, view.shape, dtype=np.uint8)) for _ in range(40)]
    assert len(numbers(still, 0.9)) == 1


def test_a_camera_too_fast_to_be_followed_gives_every_frame():
    assert numbers(views(range(0, 1200, 150)), 0.8) == list(range(8))


def test_blurred_frames_are_not_chosen_where_sharp_ones_are_near():
    frames = [
        frame if i % 5 == 3 else blurred(frame) for i, frame in enumerate(views(range(0, 480, 6)))
    ]
    chosen = numbers(frames, 0.8)
    assert len(chosen) > 5
    assert all(number % 5 == 3 for number in chosen)


@pytest.mark.parametrize("length", [28, 32])
def test_a_blurred_end_is_left_out(length):
    # The choice is among eight frames, so a whole step has sharp ones.
    frames = views(range(0, 8 * length, 8))
    frames[-5:] = [blurred(frame, 15) for frame in frames[-5:]]
    assert numbers(frames, 0.7)[-1] < length - 5


def test_after_a_moment_in_which_nothing_can_be_followed_the_way_goes_on():
    frames = views(range(0, 300, 5))
    for i in range(24, 32):
        frames[i] = cv2.blur(frames[i], (121, 121))
    chosen = list(choose_frames(iter(frames), 0.8))
    assert all(frame.motion is not None for frame in chosen[1:])
    assert not any(24 <= frame.index < 32 for frame in chosen)


def test_after_a_cut_a_new_stretch_begins():
    frames = [*views(range(0, 200, 8)), *views(range(0, 200, 8), seed=1)]
    chosen = list(choose_frames(iter(frames), 0.8))
    unknown = [frame.index for frame in chosen if frame.motion is None]
    assert len(unknown) == 2 and 25 <= unknown[1] <= 28


def test_black_frames_and_bare_walls_are_not_chosen():
    black = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 5
    chosen = numbers([*black, *views(range(0, 200, 8)), *black], 0.8)
    assert chosen and all(5 <= number < 30 for number in chosen)
    assert numbers(black, 0.8) == []


def test_few_frames_are_in_memory():
    given, most = [], 0

    def frames():
        nonlocal most
        for view in views(range(0, 600, 6)):
            frame = view.view()  # `views` keeps the pixels; counted is what the choice keeps
            given.append(weakref.ref(frame))
            yield frame
            del frame
            most = max(most, sum(each() is not None for each in given))

    assert len(list(map(lambda chosen: chosen.index, choose_frames(frames(), 0.8)))) > 6
    assert most <= 4


def test_the_choice_is_the_same_every_time():
    frames = views(range(0, 280, 7))
    first, second = (list(choose_frames(iter(frames), 0.85)) for _ in range(2))
    assert [a.index for a in first] == [b.index for b in second]
    for a, b in zip(first[1:], second[1:], strict=True):
        np.testing.assert_array_equal(a.motion, b.motion)


def test_an_overlap_that_makes_no_sense_is_refused():
    for overlap in (0.0, 1.0, -0.3):
        with pytest.raises(ValueError, match="between 0 and 1"):
            list(choose_frames([], overlap))
