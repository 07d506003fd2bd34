"""How do I compute a study on a Dask cluster?"""

import numpy as np
from distributed import LocalCluster

import crane

if __name__ == "__main__":  # workers import this file
    vary = {"payload.mass": np.linspace(0.0, 0.2, 5)}  # [kg]
    # a local cluster; for a real one, use the address that its scheduler prints
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        found = crane.study(
            "mini_forwarder", vary, ["lift"], ["energy"], scheduler=cluster.scheduler_address
        )
    print(found.to_text())
    here = crane.study("mini_forwarder", vary, ["lift"], ["energy"])
    assert np.array_equal(found.columns["energy"], here.columns["energy"])
    print("the same numbers as on one processor, to the last bit")
