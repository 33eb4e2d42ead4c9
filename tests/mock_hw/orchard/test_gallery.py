from mock_hw.orchard.gallery import PROFILE_TILE, sheet_of_profiles
from mock_hw.orchard.presets import WALNUT


def test_profiles_show_more_green_with_every_row():
    sheet = sheet_of_profiles(WALNUT, range(1)).astype(int)
    assert sheet.shape == (3 * PROFILE_TILE[1], PROFILE_TILE[0], 3)
    rows = [sheet[k * PROFILE_TILE[1] : (k + 1) * PROFILE_TILE[1]] for k in range(3)]
    crown = [row[30:170, 60:240] for row in rows]
    green = [((c[..., 1] > c[..., 2] + 15) & (c[..., 1] > c[..., 0])).mean() for c in crown]
    assert green[0] < green[1] < green[2]
