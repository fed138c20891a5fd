# %% [markdown]
# # Close the loop
# One receiver reads 6 dB too much, and nobody knows. What does the model lack, and what does knowing it bring?

# %%
import radiotwin as rt

rt.build_preset("small", "close_the_loop/scene")
scene = rt.Scene.load("close_the_loop/scene")
honest = rt.fly_survey(scene, rt.segmented_truth(scene), flights=4, pattern="random-waypoint", seed=1, noise_db=0.0)
table = honest.table.copy()
table.loc[table["receiver"] == "uav1", "gain_db"] += 6.0
measurements = rt.Measurements(table, honest.devices)

# %% [markdown]
# Without its 3D map the base is a log-distance law; with `scene` it is a twin, or followed paths, whichever errs less.

# %%
loop = rt.close_loop(measurements, base="log-distance", seed=0)
report = rt.make_report(loop)
print("verdict:", report["verdict"])
for effect in report["effects"]:
    print(effect["name"], {name: round(p["value"], 1) for name, p in effect["parameters"].items()})

# %% [markdown]
# The error before and after is of flights that took no part in fitting.

# %%
error = report["error"]
print(f"{error['before']['rmse_db']:.2f} dB before, {error['after']['rmse_db']:.2f} dB after")
rt.corrected_twin(loop, None).save("close_the_loop/twin")
