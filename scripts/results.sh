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
room() {
    once nlt compare --data real_living_room_moving_lights --workers "${WORKERS:-2}" "$@"
}
fixed_lights() {
    once nlt compare --data real_living_room_fixed_lights --workers "${WORKERS:-2}" "$@"
}
denoising="denoising_1_1 denoising_1_4 denoising_1_16 denoising_1_32 denoising_1_64"
table2="$denoising cnn feature_projection nlt nlt_photons
    oidn_1_fast oidn_1_balanced oidn_1 oidn_4 path_tracing_1 path_tracing_4"
peers="oidn_1_fast oidn_1_balanced oidn_1 oidn_2_fast oidn_2_balanced oidn_2 oidn_4_fast oidn_4_balanced oidn_4"
front="cnn@direct cnn@direct_patches guided_1spp@direct guided_1spp_1_4@direct guided_1spp_1_4@direct_patches guided_4spp@direct
    $peers path_tracing_1 path_tracing_4"
# shellcheck disable=SC2086  # lists of methods
if [ "$scale" = small ]; then
    room --config table2_real_demodulated --seeds 3 --out results/real_living_room \
        --methods $table2 cnn@direct guided_1spp guided_1spp@direct_corrected
    once nlt compare --config table2_real_demodulated --data real_dining_room_moving_lights --workers "${WORKERS:-2}" \
        --out results/real_dining_room --methods $table2 cnn@direct guided_1spp guided_1spp@direct_corrected
    once nlt compare --config table2_real_demodulated --data real_dining_room_moving_lights --scale medium_few_views \
        --workers "${WORKERS:-2}" --out results/real_dining_room_256 --methods $denoising cnn cnn@direct \
        feature_projection nlt nlt_photons oidn_1 oidn_4 path_tracing_1 path_tracing_4
    once python benchmarks/error_spectra.py results/real_dining_room_256
    once nlt compare --config table2_real_demodulated --data real_dining_room_moving_lights --scale medium_few_views \
        --seeds 3 --workers "${WORKERS:-2}" --out results/real_dining_room_256_seeds --methods nlt_photons nlt cnn \
        feature_projection
    once nlt stress --config table2_real_demodulated --data real_living_room_moving_lights --out results/real_living_room \
        --suites light geometry materials camera budget frame flicker --methods cnn cnn@direct feature_projection nlt \
        nlt_photons guided_1spp guided_1spp@direct_corrected oidn_1 oidn_4
    room --config table2_real_demodulated --scale medium --seeds 3 --out results/real_living_room_256 \
        --methods $table2 cnn@direct guided_1spp guided_1spp@direct
    once python benchmarks/error_spectra.py results/real_living_room_256
    room --config table2_real_demodulated --scale medium_few_views --out results/real_living_room_256_linear \
        --methods nlt_photons cnn@direct oidn_1 oidn_4 path_tracing_1 path_tracing_4
    once python benchmarks/error_spectra.py results/real_living_room_256_linear
    room --config table2_real --scale medium --methods $table2 --out results/real_living_room_256_radiance
    fixed_lights --config table1_real_demodulated --methods guided_1spp $table2 --out results/real_living_room_fixed_lights
    fixed_lights --config table1_real_demodulated --scale medium_sky --out results/real_living_room_fixed_lights_256 \
        --methods $denoising cnn feature_projection nlt nlt_photons guided_1spp@clean_target oidn_1 oidn_4 path_tracing_1 path_tracing_4
    once nlt compare --config table1_real_demodulated --data real_dining_room_fixed_lights --workers "${WORKERS:-2}" \
        --out results/real_dining_room_fixed_lights --methods $table2 cnn@direct guided_1spp guided_1spp@direct_corrected
    once nlt compare --config table1_real_demodulated --data real_dining_room_fixed_lights --scale medium_sky \
        --workers "${WORKERS:-2}" --out results/real_dining_room_fixed_lights_256 --methods $denoising cnn cnn@direct \
        cnn@direct_clean_target guided_1spp@direct_clean_target feature_projection nlt nlt_photons oidn_1 oidn_4 \
        path_tracing_1 path_tracing_4
    once python scripts/teaser.py results/real_dining_room_fixed_lights_256 --view 3 -o docs/sun.webp \
        --methods path_tracing_1 nlt_photons cnn@direct_clean_target guided_1spp@direct_clean_target oidn_1 oidn_4
    once nlt compare --config table1_real_demodulated --data real_dining_room_fixed_lights --scale medium_sky \
        --workers "${WORKERS:-2}" --out results/clean_target --methods cnn cnn@clean_target nlt_photons \
        nlt_photons@clean_target nlt_photons@decayed_embedding photons_only oidn_1
    once nlt compare --config table1_real_demodulated --data demo_fixed_lights --workers "${WORKERS:-2}" \
        --out results/builtin_fixed_lights --methods $table2 cnn@direct
    once nlt compare --config table1_real_demodulated --data builtin_fixed_lights --scale small_four_rooms \
        --workers "${WORKERS:-2}" --out results/four_rooms_fixed_lights --methods denoising_1_1 cnn oidn_1 oidn_4 path_tracing_4
    once nlt compare --config table1_real_demodulated --data demo_fixed_lights --scale medium_64_views \
        --workers "${WORKERS:-2}" --out results/builtin_fixed_lights_256 --methods $denoising cnn \
        feature_projection nlt nlt_photons oidn_1 oidn_4 path_tracing_4
    once nlt compare --config table1_real_demodulated --data demo_fixed_lights --scale medium_few_views --seeds 2 \
        --workers "${WORKERS:-2}" --out results/builtin_fixed_lights_256_seeds --methods feature_projection \
        nlt_photons nlt cnn
    once nlt compare --config table2_real_demodulated --data demo --workers "${WORKERS:-2}" \
        --out results/builtin_moving_lights --methods $table2 cnn@direct guided_1spp@direct_corrected
    once nlt compare --config table2_real_demodulated --data demo --seeds 3 --workers "${WORKERS:-2}" \
        --out results/builtin_moving_lights_seeds --methods nlt_photons nlt cnn feature_projection
    once nlt compare --config table2_real_demodulated --data demo --scale medium_few_views \
        --workers "${WORKERS:-2}" --out results/builtin_moving_lights_256 --methods $denoising cnn cnn@direct \
        feature_projection nlt nlt_photons oidn_1 oidn_4 path_tracing_1 path_tracing_4
    once python benchmarks/error_spectra.py results/builtin_moving_lights_256
    once nlt compare --config table2_real_demodulated --data demo --scale medium_few_views --seeds 3 \
        --workers "${WORKERS:-2}" --out results/builtin_moving_lights_256_seeds --methods nlt_photons nlt cnn \
        feature_projection
    once nlt compare --config table2_real_demodulated --data demo --scale medium_6400 --workers "${WORKERS:-2}" \
        --out results/builtin_moving_lights_256_6400 --methods $denoising cnn feature_projection nlt nlt_photons oidn_1 \
        oidn_4 path_tracing_1 path_tracing_4
    once python benchmarks/error_spectra.py results/builtin_moving_lights_256_6400
    once nlt compare --config table2_real_demodulated --data demo --scale medium_25600 --workers "${WORKERS:-2}" \
        --out results/builtin_moving_lights_256_25600 --methods nlt_photons nlt feature_projection cnn path_tracing_1
    fixed_lights --config table1_real --out results/real_living_room_fixed_lights_radiance \
        --methods cnn feature_projection nlt nlt_photons oidn_1 oidn_4 path_tracing_1
    room --config windows --scale medium --out results/windows
    once nlt compare --config table1_real_demodulated --data demo_fixed_lights --scale medium_few_views \
        --workers "${WORKERS:-2}" --out results/more_windows --methods cnn cnn@windows_12800 feature_projection \
        feature_projection@windows_12800 nlt nlt@windows_12800 nlt_photons nlt_photons@windows_12800
    room --config windows --scale pretrained --out results/windows_128 \
        --methods cnn cnn@windows_128 photons_only photons_only@windows_128
    once nlt compare --config front --data demo --scale medium --seeds 3 --workers "${WORKERS:-2}" \
        --out results/front_builtin_256 \
        --methods $front
    room --config front --scale medium --seeds 3 --out results/front_256 \
        --methods cnn@direct cnn@direct_patches guided_1spp@direct guided_1spp_1_4@direct guided_1spp_1_4@direct_patches \
        guided_1spp_1_16@direct_patches guided_4spp@direct guided_4spp_1_2@direct $peers path_tracing_1 path_tracing_4
    room --config front --scale demo --seeds 3 --out results/front_real \
        --methods cnn@direct guided_1spp guided_1spp@direct guided_1spp@direct_corrected \
        guided_1spp_relative@direct_corrected $peers
    once nlt stress --config front --data real_living_room_moving_lights --scale demo --out results/front_real \
        --suites light geometry materials camera frame flicker --methods cnn@direct guided_1spp guided_1spp@direct \
        guided_1spp@direct_corrected guided_1spp_relative@direct_corrected oidn_1 oidn_4
    room --config front --scale demo --seeds 3 --out results/zero_shot \
        --methods guided_1spp guided_1spp@direct_corrected guided_1spp_relative@direct_corrected guided_1spp@other_rooms \
        guided_1spp@direct_other_rooms guided_1spp@direct_corrected_other_rooms \
        guided_1spp_relative@direct_corrected_other_rooms oidn_1_fast oidn_1_balanced oidn_1 oidn_2_fast oidn_2_balanced oidn_2
    once python scripts/teaser.py results/front_256 --view 8 \
        --methods path_tracing_1 cnn@direct_patches guided_1spp_1_4@direct_patches oidn_1_balanced guided_1spp@direct oidn_1
    once nlt compare --config demo --seeds 3 --workers "${WORKERS:-2}" --out results/front_builtin \
        --methods cnn cnn@direct nlt_photons guided_1spp guided_1spp@direct guided_1spp@direct_corrected \
        guided_1spp_relative@direct_corrected guided_1_1@direct $peers path_tracing_1 path_tracing_4
    once nlt stress --config demo --out results/front_builtin --suites light geometry materials camera frame \
        --methods cnn cnn@direct guided_1spp guided_1spp@direct guided_1spp@direct_corrected \
        guided_1spp_relative@direct_corrected oidn_1 oidn_4
    once nlt stress --config demo --out results/trainings_builtin --suites training \
        --methods denoising_1_1 cnn feature_projection nlt nlt_photons guided_1spp@direct_corrected
    once nlt compare --config ablation_real --scale ablation_128 --seeds 3 --workers "${WORKERS:-2}" \
        --out results/ablation_egg
    once nlt compare --config static_kitchen_real_demodulated --seeds 3 --workers "${WORKERS:-2}" \
        --out results/static_kitchen
    once nlt compare --config static_kitchen_real_demodulated --workers "${WORKERS:-2}" \
        --out results/static_kitchen_linear --methods nlt feature_projection cnn@direct oidn_4 path_tracing_16
    once python benchmarks/error_spectra.py results/static_kitchen_linear
    once nlt compare --config static_bathroom_real_demodulated --seeds 3 --workers "${WORKERS:-2}" \
        --out results/static_bathroom --methods cnn cnn@direct feature_projection nlt oidn_1_balanced oidn_1 oidn_4 \
        path_tracing_1 path_tracing_4 path_tracing_16
    once python benchmarks/error_spectra.py results/static_bathroom
    room --config other_rooms --scale medium --out results/other_rooms
    room --config small_images_first --scale medium --out results/small_images_first
    room --config table2_real --out results/real_living_room_radiance \
        --methods cnn feature_projection nlt nlt_photons oidn_1 oidn_4 path_tracing_1
fi
# shellcheck disable=SC2086  # a list of methods
if [ "$scale" = gpu ]; then
    room --config table2_real --scale gpu_256 --workers 14 --seeds 2 --out results/real_living_room_256_gpu \
        --methods $denoising cnn feature_projection nlt nlt_photons path_tracing_1 path_tracing_4
    room --config table2_real --scale gpu_256_9600 --workers 9 --out results/real_living_room_256_gpu_9600 \
        --methods $denoising cnn feature_projection nlt nlt_photons path_tracing_1
    room --config table2_real_demodulated --scale gpu_256 --workers 2 --out results/real_living_room_256_gpu_direct \
        --methods guided_1spp@direct cnn@direct
fi
if [ "$scale" != small ]; then
    for comparison in table2_real table1_real ablation_real static_kitchen_real static_bathroom_real; do
        publish --config "$comparison"
    done
fi
if [ "$scale" = small ]; then
    once nlt compare --config recipe --seeds 3 --workers "${WORKERS:-2}" --out results/recipe
    parts=
    for method in feature_projection nlt photons_only guided_1_1; do
        parts="$parts $method $method@radiance $method@paper_schedule $method@adam"
    done
    once nlt compare --config recipe --workers "${WORKERS:-2}" --methods $parts --out results/recipe_methods
    for method in feature_projection nlt photons_only guided_1_1; do
        parts="$parts $method@no_emission"
    done
    once nlt compare --config recipe --scale demo --seeds 3 --workers "${WORKERS:-2}" --out results/recipe_demo \
        --methods $parts feature_projection@slow_embedding nlt@slow_embedding
    once nlt compare --config recipe --seeds 3 --workers "${WORKERS:-2}" --out results/narrow \
        --methods cnn cnn@narrow nlt_photons nlt_photons@narrow guided_1_1 guided_1_1@narrow oidn_1 oidn_4
    once nlt compare --config recipe --scale recipe_6400 --workers "${WORKERS:-2}" \
        --methods cnn cnn@before cnn@images_6400 nlt_photons nlt_photons@before photons_only@images_6400 oidn_1 oidn_4
    room --config table2_real_demodulated --scale small_6400 --out results/real_living_room_6400 \
        --methods $table2 cnn@before nlt_photons@before guided_1spp guided_1spp_field photons_only field photon_field
    once python benchmarks/selection.py --minutes 4
fi
for report in results/*/report.html; do  # small enough for git
    case $report in results/table*) megabytes=8 ;; *) megabytes=4 ;; esac
    nlt report "$(dirname "$report")" --megabytes "$megabytes"
done
