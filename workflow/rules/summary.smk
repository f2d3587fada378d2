# One page over all detectors and periods.

REPORTS = [f"{RESULTS}/{d}/{p}/report" for d, p in PAIRS]


rule summary:
    input:
        REPORTS,
    output:
        f"{RESULTS}/index.html",
    log:
        f"{RESULTS}/logs/summary.log",
    benchmark:
        f"{RESULTS}/benchmarks/summary.tsv"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
        runtime=10,
    shell:
        "cpunet compare {input:q} --out {output:q} --force > {log:q} 2>&1"


# for whoever asks: the reports that are there, the page says which are not
rule so_far:
    params:
        reports=REPORTS,
        page=f"{RESULTS}/so_far.html",
    shell:
        "cpunet compare {params.reports:q} --out {params.page:q} --force"
