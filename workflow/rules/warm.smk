# Compiled code and fields, made once: parallel first jobs would all compile at the same time.


DSP = config.get("events", {}).get("dsp", str(Path(workflow.basedir) / "config" / "dsp.yaml"))
DSP_SCRIPT = shlex.quote(str(Path(workflow.basedir) / "scripts" / "dsp.py"))


def dsp_of_a_demo(_wildcards):
    """Commands that take the pulses of the demonstration to parameters, after it."""
    if "events" not in config:
        return ""
    words = " ".join(shlex.quote(str(word)) for word in config["events"]["translate"])
    demo = '"$folder/demo'
    return (
        f'; cpunet translate {demo}/run" {demo}/stand/sim.lh5" --adc {words}'
        f' --out-table demo/raw --out "$folder/raw.lh5"; python {DSP_SCRIPT}'
        f' "$folder/raw.lh5" "$folder/dsp.lh5" --config {shlex.quote(DSP)}'
        f' --table demo/raw --run {demo}/run"'
    )


rule warm:
    output:
        touch(f"{RESULTS}/warm.done"),
    log:
        f"{RESULTS}/logs/warm.log",
    benchmark:
        f"{RESULTS}/benchmarks/warm.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=30,
    params:
        # whatever is compiled takes part in the demonstration, and dspeed's chain, if events are
        # to go through it
        events=dsp_of_a_demo,
    shell:
        "(folder=$(mktemp -d); trap 'rm -rf \"$folder\"' EXIT;"
        ' cpunet demo --quick --out "$folder/demo"{params.events})'
        " > {log:q} 2>&1"


def warmed(wildcards):
    """Wait for the compilation, unless it is switched off."""
    return rules.warm.output if config["warm"] else []


rule fields:
    input:
        warmed,
        detector=lambda w: a_file(DETECTORS[w.detector]["simulate"]["detector"]),
    output:
        f"{RESULTS}/{{detector}}/fields.png",
    log:
        f"{RESULTS}/{{detector}}/logs/fields.log",
    benchmark:
        f"{RESULTS}/{{detector}}/benchmarks/fields.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=30,
    params:
        detector=lambda w: DETECTORS[w.detector]["simulate"]["detector"],
        options=lambda w: options(set=DETECTORS[w.detector]["simulate"].get("set")),
    shell:
        "cpunet info {params.detector:q} {params.options} --out {output:q} --force"
        " > {log:q} 2>&1"
