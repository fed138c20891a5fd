"""Heights above the ground: of a drive on a terrain, whose heights above the datum nobody knows."""

import numpy as np
import pytest

from radiotwin.errors import BadInput

GIVEN = {"length_unit": "m", "columns": {"x": "x", "y": "y", "device": "d", "level": "l"}}
LOG = "x,y,d,l\n0,0,a,-80\n10,0,a,-81\n0,0,b,-90\n"


def columns(**more):
    return GIVEN | {"columns": GIVEN["columns"] | more}


def test_a_constant_height_above_the_ground(bring_in):
    result = bring_in(LOG, **columns(above_ground="always 1.5"))
    assert (result.table["receiver_above_ground_m"] == 1.5).all() and result.table["receiver_z_m"].isna().all()
    assert "above_ground_m" not in result.devices


def test_a_column_in_feet_and_that_of_devices(bring_in):
    log = "x,y,h,dx,dy,dh,d,l\n0,0,10,5,5,60,a,-80\n10,0,20,5,5,60,a,-81\n20,0,,9,9,,b,-82\n"
    result = bring_in(log, **columns(above_ground="h", device_x="dx", device_y="dy", device_above_ground="dh")
                      | {"length_unit": "ft"})
    assert result.table["receiver_above_ground_m"].tolist() == pytest.approx([3.05, 6.1, np.nan], abs=0.01, nan_ok=True)
    assert result.devices["above_ground_m"].tolist() == pytest.approx([18.29, np.nan], abs=0.01, nan_ok=True)
    assert result.devices["z_m"].isna().all()


def test_tables_have_them_too_and_the_file_comes_first(bring_in, tmp_path):
    (tmp_path / "cars.csv").write_text("receiver,x_m,y_m,above_ground_m\nvan,1,2,2.5\nbike,3,4,1.2\n")
    (tmp_path / "masts.csv").write_text("device,x_m,y_m,z_m,above_ground_m\na,0,0,,25\nb,9,9,130,\n")
    log = "who,d,l,h\nvan,a,-80,\nbike,b,-81,\nbike,a,-82,1.6\n"
    result = bring_in(log, receivers=str(tmp_path / "cars.csv"), devices=str(tmp_path / "masts.csv"), length_unit="m",
                      columns={"receiver": "who", "device": "d", "level": "l", "above_ground": "h"})
    assert result.table["receiver_above_ground_m"].tolist() == [2.5, 1.2, 1.6]
    assert result.devices["above_ground_m"].tolist() == pytest.approx([25, np.nan], nan_ok=True)
    assert result.devices["z_m"].tolist() == pytest.approx([np.nan, 130], nan_ok=True)


def test_of_two_heights_one_is_to_be_chosen(bring_in):
    with pytest.raises(BadInput, match="with one of altitude, height, z, above_ground; given are above_ground, height"):
        bring_in(LOG, **columns(above_ground="always 1.5", height="always 3"))


@pytest.mark.parametrize("setting, rows", [({"thin_m": 2.0}, 2), ({"average_m": 4.0}, 2)])
def test_a_climb_is_a_way(bring_in, setting, rows):
    log = "time,x,y,h,d,l\n0,0,0,5,a,-80\n1,0,0,6,a,-81\n2,0,0,9.5,a,-82\n"
    result = bring_in(log, **columns(above_ground="h", time="time"), time_format="epoch s", **setting)
    assert len(result.table) == rows


def test_a_place_of_the_file_has_the_height_of_the_table(bring_in, tmp_path):
    """A height of the file, above whatever, comes before it; so does none at all where the table has none."""
    (tmp_path / "masts.csv").write_text("device,x_m,y_m,z_m\na,0,0,25\nb,9,9,30\nc,1,1,\n")
    log = "x,y,dx,dy,dh,d,l\n0,0,1,1,,a,-80\n0,0,2,2,7,b,-81\n0,0,3,3,,c,-82\n0,0,,,,c,-83\n"
    with pytest.raises(BadInput, match="'c' has positions"):
        bring_in(log, devices=str(tmp_path / "masts.csv"), **columns(device_x="dx", device_y="dy"))
    result = bring_in(log.rsplit("\n", 2)[0], devices=str(tmp_path / "masts.csv"),
                      **columns(device_x="dx", device_y="dy", device_above_ground="dh"))
    assert result.devices[["x_m", "y_m"]].to_numpy().tolist() == [[1, 1], [2, 2], [3, 3]]
    assert result.devices["z_m"].tolist() == pytest.approx([25, np.nan, np.nan], nan_ok=True)
    assert result.devices["above_ground_m"].tolist() == pytest.approx([np.nan, 7, np.nan], nan_ok=True)
