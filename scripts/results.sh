#!/bin/sh
# The published results, the most important first: sh scripts/results.sh [SCALE] (small, gpu, paper).
# It may be killed at any time, and given again goes on with what is missing; on a machine lent for half an hour:
# timeout 30m sh scripts/results.sh gpu
set -eu
scale=${1:-small}
mkdir -p runs/done
once() {
    done="runs/done/$(echo "$* $scale" | cksum | tr ' ' -)"  # a file's name may not be as long as a command
    [ -e "$done" ] || { "$@" && touch "$done"; }
}
publish() {
    once nlt compare --scale "$scale" --workers "${WORKERS:-2}" "$@"
}
publish --config table2 --seeds 3
publish --config table1 --seeds 3
publish --config ablation --seeds 3
publish --config ablation --data real/static_egg
publish --config static_kitchen
publish --config static_bathroom
publish --config static_kitchen --data static_kitchen
publish --config static_bathroom --data static_bathroom
publish --config table2 --data dynamic_moving_lights --seeds 3
publish --config table1 --data dynamic_fixed_lights --seeds 3
once nlt stress --config table2 --scale "$scale" --views 1
if [ "$scale" = small ]; then
    once python benchmarks/leaner.py --seeds 2
    once python benchmarks/selection.py --minutes 20
    once nlt compare --config diagnosis
    once nlt compare --config diagnosis --scale leaner_128 --methods path_tracing_1 denoising_1_1 denoising_1_16 \
        denoising_1_32 denoising_1_64 cnn feature_projection nlt nlt_photons
    once nlt compare --config diagnosis --scale leaner_3200 --methods cnn feature_projection nlt nlt_photons
fi
for report in results/*/report.html; do  # small enough for git
    case $report in results/table*) megabytes=8 ;; *) megabytes=4 ;; esac
    nlt report "$(dirname "$report")" --megabytes "$megabytes"
done
