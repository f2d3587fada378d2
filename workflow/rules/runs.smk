# A training or a calibration per detector and period, and what is done with it.

# one of both makes the run, the other has a name that nothing asks for
CALIBRATED = "calibrate" in config
TRAINED = f"{RESULTS}/{{detector}}/{{period}}/run"


def calibration_options(wildcards):
    """Words of a calibration: what is free, and how the two files are read."""
    words, training = config["calibrate"], config["train"]
    if training["set"]:
        raise WorkflowError(
            "configuration, train.set: a calibration takes a recipe without; put the values "
            "into a file and give it as train.recipe"
        )
    of_data = data_reading(wildcards.detector, wildcards.period)
    if len(DATA[wildcards.detector, wildcards.period]) > 1:
        of_data = {}  # merged
    return options(
        free=words["free"] or None,
        prior=words["prior"],
        events=words["events"],
        peak=training["peak"],
        recipe=training["recipe"],
        seed=training["seed"],
        data_table=of_data.pop("table", None),
        data_energy=of_data.pop("energy", None),
        **of_data,
    )


rule calibrate:
    input:
        warmed,
        sim=one_simulation,
        data=one_data,
        energies=lambda w: ENERGIES.get((w.detector, w.period), []),
        recipe=a_file(config["train"]["recipe"]),
    output:
        directory(TRAINED if CALIBRATED else f"{TRAINED}-calibrated"),
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/calibrate.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/calibrate.tsv"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=120,
    params:
        options=lambda w: calibration_options(w) if CALIBRATED else "",
    shell:
        "cpunet calibrate --sim {input.sim:q} --data {input.data:q} {params.options}"
        " --out {output:q} --force > {log:q} 2>&1 || [ -f {output:q}/run.json ]"


rule train:
    input:
        warmed,
        sim=one_simulation,
        data=one_data,
        energies=lambda w: ENERGIES.get((w.detector, w.period), []),
        recipe=a_file(config["train"]["recipe"]),
    output:
        directory(f"{TRAINED}-trained" if CALIBRATED else TRAINED),
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/train.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/train.tsv"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=60,
    params:
        reading=reading,
        options=options(**config["train"], device=config["device"]),
    shell:
        # a run whose fit is bad is used: its log, each use and the page of all say so
        "cpunet train --sim {input.sim:q} --data {input.data:q} {params.reading}"
        " {params.options} --out {output:q} --force > {log:q} 2>&1"
        " || [ -f {output:q}/run.json ]"


rule translate:
    input:
        run=TRAINED,
        pulses=lambda w: SIMULATIONS[w.detector][w.part],
    output:
        f"{RESULTS}/{{detector}}/{{period}}/translated/{{part}}.lh5",
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/translate-{{part}}.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/translate-{{part}}.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=120,
    params:
        options=lambda w: options(
            # noise of its own in each file
            seed=config["train"]["seed"] + list(SIMULATIONS[w.detector]).index(w.part),
        ),
        reading=lambda w: simulation_reading(w.detector),
    shell:
        "cpunet translate {input.run:q} {input.pulses:q} {params.options} {params.reading}"
        " --out {output:q} --force > {log:q} 2>&1"


rule validate:
    input:
        run=TRAINED,
        sim=one_simulation,
        data=one_data,
        energies=lambda w: ENERGIES.get((w.detector, w.period), []),
    output:
        directory(f"{RESULTS}/{{detector}}/{{period}}/report"),
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/validate.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/validate.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=60,
    params:
        reading=reading,
        options=options(seed=config["train"]["seed"]),
        baselines="--baselines" if config["validate"]["baselines"] else "--no-baselines",
    shell:
        "cpunet validate {input.run:q} --sim {input.sim:q} --data {input.data:q}"
        " {params.reading} {params.options} {params.baselines} --out {output:q} --force"
        " > {log:q} 2>&1"
