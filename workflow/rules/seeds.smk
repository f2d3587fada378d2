# How scores depend on the seed: a training and a validation for each, and one page for all.

SEEDED = f"{RESULTS}/{{detector}}/{{period}}/seeds/{{seed}}"
SEED_PAGES = [f"{RESULTS}/{d}/{p}/seeds.html" for d, p in PAIRS] if "seeds" in config else []


use rule train as train_seed with:
    output:
        directory(f"{SEEDED}/run"),
    log:
        f"{SEEDED}/logs/train.log",
    benchmark:
        f"{SEEDED}/benchmarks/train.tsv"
    params:
        reading=reading,
        options=lambda w: options(**config["train"] | {"seed": w.seed}, device=config["device"]),


# with the same noise and bootstrap samples for all: they differ only in the training
use rule validate as validate_seed with:
    input:
        run=f"{SEEDED}/run",
        sim=one_simulation,
        data=one_data,
        energies=lambda w: ENERGIES.get((w.detector, w.period), []),
    output:
        directory(f"{SEEDED}/report"),
    log:
        f"{SEEDED}/logs/validate.log",
    benchmark:
        f"{SEEDED}/benchmarks/validate.tsv"


rule compare_seeds:
    input:
        lambda w: [
            f"{SEEDED}/report".format(**dict(w), seed=seed) for seed in config["seeds"]
        ],
    output:
        f"{RESULTS}/{{detector}}/{{period}}/seeds.html",
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/seeds.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/seeds.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
        runtime=10,
    shell:
        "cpunet compare {input:q} --out {output:q} --force > {log:q} 2>&1"


# for whoever wants these alone
rule seeds:
    input:
        SEED_PAGES,
