"""Normalised cuts: what they part, what they leave whole, and that cells give the segments of the published rule."""

import cv2
import numpy as np
import pytest
from scipy.sparse import csr_matrix

from l3ps.segment.cuts import fuse_cuts
from l3ps.segment.ncut import MAX_COST, best_cut, cut, line, offsets

CAR, BUS, PEDESTRIAN, ROAD = 4, 3, 7, 11


def discs(*centres, radius=20, shape=(80, 160), gap=0, noise=0.0, seed=0):
    """Touching discs and the boundary around each; ``gap`` pixels of every line between two are missing."""
    owner = np.zeros(shape, np.int32)
    for k, (x, y) in enumerate(centres, 1):
        cv2.circle(owner, (x, y), radius, k, -1)
    kernel = np.ones((3, 3), np.uint8)
    ids = owner.astype(np.float32)
    strength = (cv2.dilate(ids, kernel) != cv2.erode(ids, kernel)).astype(np.float32) * 0.9
    if gap:
        middle = shape[0] // 2
        strength[middle - gap // 2 : middle - gap // 2 + gap] = 0
    strength += np.float32(noise) * np.random.default_rng(seed).random(shape, dtype=np.float32)
    return np.clip(strength, 0, 1), owner


def same_segments(found, owner, least=0.9):
    """Each of the owner's segments is one of those found, up to their rims."""
    for k in range(1, owner.max() + 1):
        best = np.bincount(found[owner == k]).argmax()
        shared = ((found == best) & (owner == k)).sum()
        assert shared / ((found == best) | (owner == k)).sum() > least


def large(parts, least=60):
    return int((np.bincount(parts.ravel())[1:] >= least).sum())


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(
    "centres", [[(40, 40), (78, 40)], [(40, 40), (78, 40), (116, 40)], [(40, 30), (78, 40), (60, 62)]]
)
def test_touching_discs_are_parted_where_the_boundary_runs(centres, noise):
    strength, owner = discs(*centres, noise=noise)
    parts = cut(strength, owner > 0, 60)
    assert large(parts) == len(centres)
    same_segments(parts, owner)
    assert ((parts > 0) == (owner > 0)).all()


@pytest.mark.parametrize("radius", [4, 20, 39])
def test_a_disc_alone_stays_whole(radius):
    strength, owner = discs((80, 40), radius=radius)
    inner = strength * (cv2.erode((owner > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0)
    assert large(cut(inner, owner > 0, 60), 30) == 1


def test_no_boundary_no_cut_however_long_and_thin():
    mask = np.zeros((40, 400), bool)
    mask[15:25, 5:395] = True
    assert cut(np.zeros(mask.shape, np.float32), mask).max() == 1


def test_a_boundary_with_a_wide_gap_parts_nothing():
    strength, owner = discs((40, 40), (78, 40), gap=0)
    assert large(cut(strength, owner > 0, 60)) == 2
    strength, owner = discs((40, 40), (70, 40), gap=12)
    assert large(cut(strength, owner > 0, 60)) == 1


def test_the_same_comes_out_again_and_in_reading_order():
    strength, owner = discs((40, 40), (78, 40), (116, 40), noise=0.05, seed=3)
    first = cut(strength, owner > 0, 60)
    np.testing.assert_array_equal(first, cut(strength.copy(), owner > 0, 60))
    seen = first.ravel()[np.sort(np.unique(first, return_index=True)[1])]
    assert (seen[seen > 0] == np.arange(1, first.max() + 1)).all()


def test_nothing_one_pixel_and_two():
    for count in (0, 1, 2):
        mask = np.zeros((3, 4), bool)
        mask[1, :count] = True
        assert cut(np.zeros((3, 4), np.float32), mask).sum() == count


def test_the_neighbourhood_is_half_of_a_circle_of_radius_five():
    half = offsets()
    assert len(half) == len(set(half)) == 40
    assert not {(-y, -x) for y, x in half} & set(half)
    assert line(2, 5)[0] == (0, 0)
    assert line(2, 5)[-1] == (2, 5)
    assert all(max(abs(b - a), abs(d - c)) == 1 for (a, c), (b, d) in zip(line(2, 5)[:-1], line(2, 5)[1:], strict=True))


def pixel_affinity(strength, mask):
    """The published affinity, pixel by pixel."""
    height, width = mask.shape
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(mask.sum())
    rows, columns, values = [], [], []
    for y, x in zip(*np.nonzero(mask), strict=True):
        for down, right in offsets():
            v, u = y + down, x + right
            if 0 <= v < height and 0 <= u < width and mask[v, u]:
                worst = max(strength[y + a, x + b] for a, b in line(down, right))
                rows.append(number[y, x])
                columns.append(number[v, u])
                values.append(np.exp(-70 * float(worst)))
    half = csr_matrix((values, (rows, columns)), shape=(mask.sum(),) * 2)
    return (half + half.T).toarray()


def cut_by_pixel(affinity, least):
    """The published recursion with one unknown a pixel; the pixels of each segment."""
    done, todo = [], [np.arange(len(affinity))]
    while todo:
        members = todo.pop()
        members = members[affinity[np.ix_(members, members)].sum(axis=1) > 0]  # a pixel alone is no segment
        if len(members) < least:
            continue
        found = best_cut(affinity[np.ix_(members, members)])
        bins, _ = np.histogram(found.vector, 20)
        if found.cost > MAX_COST or bins.min() > 0.03 * bins.max():
            done.append(members)
        else:
            todo += [members[found.side], members[~found.side]]
    return done


@pytest.mark.parametrize("seed", range(6))
def test_cells_part_what_pixels_part(seed):
    rng = np.random.default_rng(seed)
    centres = [(9 + 13 * k, int(13 + rng.integers(-3, 4))) for k in range(seed % 3 + 1)]
    strength, owner = discs(*centres, radius=8, shape=(26, 46), noise=0.03, seed=seed)
    mask = owner > 0
    wanted = np.zeros(mask.shape, np.int32)
    for k, members in enumerate(cut_by_pixel(pixel_affinity(strength, mask), 60), 1):
        wanted[tuple(axis[members] for axis in np.nonzero(mask))] = k
    _, near = cv2.distanceTransformWithLabels(
        (wanted == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    wanted[mask] = wanted[wanted > 0][near[mask] - 1]
    found = cut(strength, mask, 60)
    assert large(found) == wanted.max() == len(centres)
    same_segments(found, wanted, 0.85)


def street():
    """Two touching pedestrians, a bus with a speck of car on it, and a car that no boundary surrounds."""
    instance = np.zeros((225, 400), np.int32)
    semantic = np.full(instance.shape, ROAD, np.uint8)
    for k, (value, x, y, w, h) in enumerate(
        [(PEDESTRIAN, 40, 60, 30, 80), (PEDESTRIAN, 70, 64, 30, 80), (BUS, 150, 40, 120, 90), (CAR, 190, 70, 24, 24)], 1
    ):
        instance[y : y + h, x : x + w], semantic[y : y + h, x : x + w] = k, value
    semantic[150:190, 300:360] = CAR
    semantic[5:9, 5:9] = CAR
    kernel = np.ones((3, 3), np.uint8)
    ids = instance.astype(np.float32)
    inside = 1 - (cv2.dilate(ids, kernel) != cv2.erode(ids, kernel)).astype(np.float32)
    return semantic, inside, instance


def test_a_street_is_fused_by_the_published_rules():
    semantic, inside, _ = street()
    panoptic = fuse_cuts(semantic, (400, 225), inside, min_area=100 / semantic.size)
    left, right = panoptic.instance[100, 55], panoptic.instance[100, 85]
    assert left > 0
    assert right > 0
    assert left != right, "the pedestrians touch, and a boundary runs between"
    assert (panoptic.semantic[70:94, 190:214] == BUS).all(), "a thing inside another is none"
    assert len(np.unique(panoptic.instance[40:130, 150:270])) == 1
    assert (panoptic.semantic[150:190, 300:360] == ROAD).all(), "no boundary, no thing"
    assert (panoptic.semantic[5:9, 5:9] == ROAD).all(), "too small"
    assert len(np.unique(panoptic.instance)) == 4
    assert panoptic.size == (400, 225)


@pytest.mark.parametrize("scale", [0.4, 1.0, 1.7])
def test_labels_and_boundary_may_be_of_any_resolution(scale):
    semantic, inside, _ = street()
    coarse = cv2.resize(semantic, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    panoptic = fuse_cuts(coarse, (400, 225), inside, min_area=100 / (225 * 400))
    assert panoptic.instance.shape == coarse.shape
    assert len(np.unique(panoptic.instance)) == 4


@pytest.mark.parametrize("value", [0, ROAD, CAR])
def test_an_image_of_one_class_without_a_boundary_has_no_objects(value):
    semantic = np.full((30, 40), value, np.uint8)
    panoptic = fuse_cuts(semantic, (40, 30), np.ones((30, 40), np.float32))
    assert not panoptic.instance.any()
    assert (panoptic.semantic == (0 if value == CAR else value)).all()


def test_what_is_no_number_is_no_boundary():
    semantic, inside, _ = street()
    inside[:30] = np.nan
    panoptic = fuse_cuts(semantic, (400, 225), inside, min_area=100 / semantic.size)
    assert len(np.unique(panoptic.instance)) == 4
