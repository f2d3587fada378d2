# Simulated and measured pulses: one job per file, then one file per training.


def simulation_options(wildcards):
    entry = DETECTORS[wildcards.detector]["simulate"]
    first = entry.get("seed", 0)
    number = list(SIMULATIONS[wildcards.detector]).index(wildcards.part)
    words = options(
        detector=entry["detector"],
        events=entry.get("events"),
        hits=HITS.get(wildcards.detector, {}).get(wildcards.part),
        seed=first + number,
        set=entry.get("set"),
    )
    more = " ".join(shlex.quote(str(word)) for word in entry.get("options", []))
    return f"{words} {more}"


rule simulate:
    input:
        rules.fields.output,
        hits=lambda w: HITS.get(w.detector, {}).get(w.part, []),
    output:
        f"{RESULTS}/{{detector}}/simulated/{{part}}.lh5",
    log:
        f"{RESULTS}/{{detector}}/logs/simulate-{{part}}.log",
    benchmark:
        f"{RESULTS}/{{detector}}/benchmarks/simulate-{{part}}.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=120,
    params:
        options=simulation_options,
    shell:
        "cpunet simulate {params.options} --out {output:q} --force > {log:q} 2>&1"


MERGE = shlex.quote(str(Path(workflow.basedir) / "scripts" / "merge.py"))


rule merge_simulation:
    input:
        warmed,
        files=lambda w: list(SIMULATIONS[w.detector].values()),
    output:
        temp(f"{RESULTS}/{{detector}}/simulation.lh5"),
    log:
        f"{RESULTS}/{{detector}}/logs/merge_simulation.log",
    benchmark:
        f"{RESULTS}/{{detector}}/benchmarks/merge_simulation.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=120,
    params:
        options=lambda w: simulation_reading(w.detector),
    shell:
        f"python {MERGE} {{output:q}} --made-table geds/sim {{params.options}}"
        " --files {input.files:q} > {log:q} 2>&1"


rule merge_data:
    input:
        warmed,
        files=lambda w: DATA[w.detector, w.period],
        energies=lambda w: ENERGIES.get((w.detector, w.period), []),
    output:
        temp(f"{RESULTS}/{{detector}}/{{period}}/data.lh5"),
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/merge_data.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/merge_data.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=240,
    params:
        options=lambda w: options(**data_reading(w.detector, w.period)),
    shell:
        f"python {MERGE} {{output:q}} --made-table geds/raw {{params.options}}"
        " --files {input.files:q} > {log:q} 2>&1"


def simulation_reading(detector):
    entry = DETECTORS[detector]
    return options(table=entry.get("sim_table"))


def data_reading(detector, period):
    """How measured files are read; with files of energies, one energy for each."""
    entry = DETECTORS[detector]
    energy = entry.get("energy")
    energies = ENERGIES.get((detector, period))
    return {
        "table": entry.get("table"),
        "energy": [f"{file}:{energy}" for file in energies] if energies else energy,
        "kev_per_adc": entry.get("kev_per_adc"),
        "dt_ns": entry.get("dt_ns"),
    }


def one_simulation(wildcards):
    """The file itself if there is but one."""
    files = list(SIMULATIONS[wildcards.detector].values())
    return files[0] if len(files) == 1 else f"{RESULTS}/{wildcards.detector}/simulation.lh5"


def one_data(wildcards):
    files = DATA[wildcards.detector, wildcards.period]
    merged = f"{RESULTS}/{wildcards.detector}/{wildcards.period}/data.lh5"
    return files[0] if len(files) == 1 else merged


def reading(wildcards):
    """How ``cpunet train`` and ``validate`` read the two files; merged ones need no words."""
    words = {}
    if len(SIMULATIONS[wildcards.detector]) == 1:
        entry = DETECTORS[wildcards.detector]
        words["sim_table"] = entry.get("sim_table")
    if len(DATA[wildcards.detector, wildcards.period]) == 1:
        of_data = data_reading(wildcards.detector, wildcards.period)
        for name in ("table", "energy"):
            words[f"data_{name}"] = of_data.pop(name)
        words |= of_data
    return options(**words)
