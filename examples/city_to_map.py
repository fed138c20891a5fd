# %% [markdown]
# # From a city to a radio map
# A small synthetic city, its ray-traced truth, and the map as files for other programs. For a city
# of your own see `radiotwin build-scene`. Tracing needs libLLVM 17 or newer; without it the
# statistical truth is used.

# %%
from pathlib import Path

import xarray

import radiotwin as rt
from radiotwin.maps.export import write_csv
from radiotwin.report import write_picture
from radiotwin.runtime import llvm

out = Path("city_to_map")
rt.build_preset("small", out / "scene")
scene = rt.Scene.load(out / "scene")
print(scene.config.name, scene.lattice.shape, "positions (z, y, x);",
      len(scene.config.devices), "devices")

# %% [markdown]
# The gain at every position where a UAV can be, here for one device. NaN: not detected.

# %%
if llvm.available():
    radio_map = rt.trace_map(scene, rt.SolverSettings.of_quality("fast"), out / "map.nc", ["d3"])
else:
    radio_map = rt.segmented_truth(scene)
    radio_map.save(out / "map.nc")
gain_db = radio_map.dataset["gain_db"]
print(f"{float(gain_db.isnull().mean()):.1%} of all links are not detected")
print(gain_db.sel(device="d3", z=55.0).sel(x=100.0, y=100.0, method="nearest").item(), "dB")

# %% [markdown]
# As a table, as a picture, and as a page with the city in 3D. xarray reads the NetCDF file with its
# units.

# %%
write_csv(radio_map, scene, out / "map.csv")
write_picture(radio_map, scene, out / "map.png")
rt.write_report(rt.read_run(out), out / "report.html")
with xarray.open_dataset(out / "map.nc", engine="h5netcdf") as dataset:
    print(dataset["gain_db"].attrs["units"], dict(dataset.sizes))
