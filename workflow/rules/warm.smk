# Compiled code and fields, made once: parallel first jobs would all compile at the same time.


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
        # whatever is compiled takes part in a small demonstration
        demo="--events FEP=400,SEP=60,DEP=60 --set training.steps=1"
        " --set training.start_factors=[1.0] --set scores.bootstraps=20",
    shell:
        "(folder=$(mktemp -d); trap 'rm -rf \"$folder\"' EXIT;"
        ' cpunet demo {params.demo} --device cpu --out "$folder/demo") > {log:q} 2>&1'


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
        "cpunet fields {params.options} --out {output:q} --force {params.detector:q}"
        " > {log:q} 2>&1"
