# Simulated events: steps of remage → pulses → raw traces of each period → their parameters.

OF_EVENTS = f"{RESULTS}/{{detector}}" + ("/{period}" if CALIBRATED else "")
PARAMETERS = [
    f"{RESULTS}/{d}/{p}/events/dsp/{name}.lh5" for d, p in PAIRS for name in EVENTS.get(d, {})
]


def event_seed(wildcards):
    """Noise of its own in each file."""
    return config["train"]["seed"] + list(EVENTS[wildcards.detector]).index(wildcards.events)


rule event_pulses:
    input:
        warmed,
        physics=physics_files,
        hits=lambda w: EVENTS[w.detector][w.events],
    output:
        f"{OF_EVENTS}/events/pulses/{{events}}.lh5",
    log:
        f"{OF_EVENTS}/logs/event_pulses-{{events}}.log",
    benchmark:
        f"{OF_EVENTS}/benchmarks/event_pulses-{{events}}.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=240,
    params:
        physics=physics,
        stp=lambda w: DETECTORS[w.detector].get("stp", w.detector),
        words=words_of("events", "simulate"),
    shell:
        "cpunet simulate {params.physics} --hits {input.hits:q} --hits-detector {params.stp:q}"
        " {params.words} --out {output:q} --force > {log:q} 2>&1"


rule event_raw:
    input:
        run=TRAINED,
        pulses=f"{OF_EVENTS}/events/pulses/{{events}}.lh5",
    output:
        f"{RESULTS}/{{detector}}/{{period}}/events/raw/{{events}}.lh5",
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/event_raw-{{events}}.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/event_raw-{{events}}.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=240,
    params:
        seed=event_seed,
        words=words_of("events", "translate"),
    shell:
        "cpunet translate {input.run:q} {input.pulses:q} --adc {params.words}"
        " --out-table {wildcards.detector}/raw --seed {params.seed}"
        " --out {output:q} --force > {log:q} 2>&1"


rule event_parameters:
    input:
        run=TRAINED,
        raw=f"{RESULTS}/{{detector}}/{{period}}/events/raw/{{events}}.lh5",
        dsp=DSP,
    output:
        f"{RESULTS}/{{detector}}/{{period}}/events/dsp/{{events}}.lh5",
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/event_parameters-{{events}}.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/event_parameters-{{events}}.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=240,
    params:
        words=options(tau_us=config.get("events", {}).get("tau_us")),
    shell:
        f"python {DSP_SCRIPT} {{input.raw:q}} {{output:q}} --config {{input.dsp:q}}"
        " --table {wildcards.detector}/raw --run {input.run:q} {params.words} > {log:q} 2>&1"


# for whoever wants these alone
rule parameters:
    input:
        PARAMETERS,
