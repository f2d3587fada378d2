# Pulse-shape libraries: ideal ones of a detector, and behind the electronics of each period.

# calibrated physics are those of a period
IDEAL = (
    f"{RESULTS}/{{detector}}/{{period}}/library/ideal.lh5"
    if CALIBRATED
    else f"{RESULTS}/{{detector}}/library/ideal.lh5"
)
CURRENT = f"{RESULTS}/{{detector}}/{{period}}/library/current.lh5"
LIBRARIES = (
    [CURRENT.format(detector=d, period=p) for d, p in PAIRS] if "library" in config else []
)


def words_of(part, key):
    return " ".join(shlex.quote(str(word)) for word in config.get(part, {}).get(key, []))


def physics(wildcards, settings=True):
    """The detector to simulate, calibrated if it is; words for the command line."""
    if CALIBRATED:
        run = TRAINED.format(**dict(wildcards))
        words = {"detector": f"{run}/detector.yaml"}
        return options(**words, set=f"{run}/settings.yaml" if settings else None)
    entry = DETECTORS[wildcards.detector]["simulate"]
    return options(detector=entry["detector"], set=entry.get("set"))


def physics_files(wildcards):
    """What these depend on."""
    if CALIBRATED:
        return TRAINED.format(**dict(wildcards))
    return a_file(DETECTORS[wildcards.detector]["simulate"]["detector"])


rule ideal_library:
    input:
        warmed,
        physics=physics_files,
    output:
        IDEAL,
    log:
        IDEAL.replace("library/ideal.lh5", "logs/ideal_library.log"),
    benchmark:
        IDEAL.replace("library/ideal.lh5", "benchmarks/ideal_library.tsv")
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=120,
    params:
        # a library has a sampling of its own, so that it takes the detector alone
        physics=lambda w: physics(w, settings=False),
        grid=config.get("library", {}).get("grid_mm"),
        words=words_of("library", "make"),
    shell:
        "cpunet library make {params.physics} --grid-mm {params.grid} {params.words}"
        " --out {output:q} --force > {log:q} 2>&1"


rule current_library:
    input:
        run=TRAINED,
        library=IDEAL,
    output:
        CURRENT,
    log:
        f"{RESULTS}/{{detector}}/{{period}}/logs/current_library.log",
    benchmark:
        f"{RESULTS}/{{detector}}/{{period}}/benchmarks/current_library.tsv"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=120,
    params:
        words=words_of("library", "translate"),
    shell:
        "cpunet library translate {input.run:q} {input.library:q} {params.words}"
        " --out {output:q} --force > {log:q} 2>&1"


# for whoever wants these alone
rule libraries:
    input:
        LIBRARIES,
