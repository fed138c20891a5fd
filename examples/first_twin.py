"""From a scene to a twin in a dozen lines, with a statistical truth (no ray tracer needed)."""

from radiotwin.compare import compare_models, split_flights
from radiotwin.scene import Scene
from radiotwin.scene.presets import build_preset
from radiotwin.survey import fly_survey, segmented_truth

build_preset("small", "first_twin/scene")
scene = Scene.load("first_twin/scene")
truth = segmented_truth(scene)
measurements = fly_survey(scene, truth, flights=4, pattern="random-waypoint", seed=0, noise_db=0.0)

train, test = split_flights(measurements, held_out=1)
comparison = compare_models(train, test, scene, truth, seed=0, models=("log_distance", "segmented_nn"))
print(comparison.location_summary().to_string(index=False))

twin = comparison.twins["segmented_nn"]
twin.save("first_twin/twin")
gain_db = twin.radio_map(scene).dataset["gain_db"]  # an xarray.DataArray
print(gain_db.sel(device="d3", z=55.0).sel(x=100.0, y=100.0, method="nearest").item(), "dB")
