"""What docs/reliability.md says in words: what was tried, what happens, and which tests show it.

How often, when and with which result is counted by the tests themselves (tests/counts.py).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One row of the table of what was tried. A test is named as `file::function`."""

    tried: str
    happens: str
    tests: tuple[str, ...]


@dataclass(frozen=True)
class Attack:
    """One failure of the first attack, with the tests that failed before it was mended.

    Without a test, `now` is the reason why it is left.
    """

    number: str
    severity: str
    happened: str
    now: str
    tests: tuple[str, ...]


FUZZED = (
    "photo, memory, learned word, GLB, OBJ, PLY, STL, imported object, episode list, run manifest, "
    "published table, boxes, checkpoint pipeline, condition, instruction: mutated"
)

TRIED = (
    Row(
        FUZZED,
        "read, or refused in one line",
        ("test_fuzz::test_a_mutated_file_is_read_or_refused_in_one_line",),
    ),
    Row(
        "recordings: mutated, without an index",
        "a process of its own reads them; one that ends is named",
        ("test_fuzz::test_a_mutated_recording_ends_no_process_of_ours",),
    ),
    Row(
        "a damaged recording among others in a query",
        "named, the others answer",
        (
            "test_catalog::test_a_recording_that_ends_its_reader_is_named_and_the_others_are_read",
            "test_catalog::test_flipped_bits_leave_a_query_its_other_recordings",
        ),
    ),
    Row(
        "corrections: damaged, absent, of a recording that is gone, of another policy",
        "`query` and its server name a damaged one, `diagnose` ends in one line that says to "
        "delete it; without one the recorded case holds; one without its recording, or of another "
        "policy, does not count",
        (
            "test_odd_recordings::test_a_damaged_layer_is_one_line",
            "test_odd_recordings::test_a_layer_that_ends_its_reader_is_named",
            "test_browse::test_the_browser_shows_corrected_cases_and_leaves_a_damaged_layer_out",
            "test_catalog::test_a_damaged_layer_is_one_line",
            "test_catalog::test_a_correction_without_its_recording_is_left_out",
            "test_diagnosis::test_a_correction_is_of_the_policy_that_was_recorded",
        ),
    ),
    Row(
        "a picture with EPS content, as a photo and as a texture",
        "no program starts",
        (
            "test_scan_files::test_a_texture_starts_no_program",
            "test_memory::test_a_photo_starts_no_program",
        ),
    ),
    Row(
        "meshes: faces without vertices, no area, lengths of 1e-30 and 1e200, NaN, too few texture "
        "coordinates",
        "one line",
        (
            "test_hostile_meshes::test_a_broken_surface_is_one_line",
            "test_hostile_meshes::test_indices_beyond_the_vertices_are_refused",
            "test_hostile_meshes::test_fewer_texture_coordinates_than_vertices_are_refused",
        ),
    ),
    Row(
        "a mesh that is placed a million times",
        "counted before it is copied",
        ("test_hostile_meshes::test_a_mesh_placed_a_million_times_is_counted_before_it_is_copied",),
    ),
    Row(
        "an import that takes much memory or time",
        "ends at 6 GB or 300 s of CPU, in one line",
        (
            "test_hostile_meshes::test_an_import_has_a_limit_of_memory",
            "test_hostile_meshes::test_an_import_has_a_limit_of_time",
        ),
    ),
    Row(
        "convex decomposition that does not end, waits, or dies",
        "ended after its limit, in one line",
        (
            "test_scan_files::test_splitting_that_does_not_end_is_ended",
            "test_scan_files::test_a_splitter_that_waits_is_ended",
            "test_scan_files::test_a_splitter_that_dies_is_said",
        ),
    ),
    Row(
        "a pipe or a device where a file is expected",
        "refused at once",
        (
            "test_pipes::test_a_pipe_is_not_waited_for",
            "test_pipes::test_a_device_is_no_file",
            "test_hostile_meshes::test_a_pipe_beside_an_obj_is_not_waited_for",
        ),
    ),
    Row(
        "conditions that would end the process",
        "refused",
        ("test_condition::test_what_could_end_the_process_is_refused",),
    ),
    Row(
        "run folders and published tables of any content",
        "read, or one line",
        (
            "test_run_schema::test_any_note_of_a_run_is_read_or_refused",
            "test_run_schema::test_a_published_table_with_other_notes_is_refused",
            "test_run_schema::test_any_column_of_a_run_is_read_or_refused",
        ),
    ),
    Row(
        "damaged tables of attention, inspection, audits, saved states and learned words",
        "one line",
        (
            "test_promises::test_a_damaged_table_is_one_line_wherever_it_is_read",
            "test_promises::test_meshes_videos_and_checkpoints_are_read_in_one_place_each",
        ),
    ),
    Row(
        "a policy that returns another shape, type or number of chunks, or lacks a part of its "
        "protocol",
        "one line ends the run",
        (
            "test_policy_faults::test_what_breaks_the_protocol_ends_the_run_in_one_line",
            "test_policy_faults::test_a_policy_that_lacks_a_part_is_refused_before_the_first_step",
        ),
    ),
    Row(
        "a policy that raises, exits, hangs or plans NaN",
        "its episode is an error, the others are kept",
        (
            "test_policy_faults::test_a_fault_is_the_error_of_its_episode",
            "test_policy_faults::test_sys_exit_at_the_start_of_an_episode_is_its_error",
            "test_policy_faults::test_a_call_that_hangs_is_ended",
        ),
    ),
    Row(
        "a policy that writes into its images",
        "NumPy refuses; the recording shows what was prompted",
        ("test_policy_faults::test_a_policy_cannot_write_into_what_it_is_shown",),
    ),
    Row(
        "actions of 100 m and 1e30",
        "cut to the robot's speed; the row says how many",
        ("test_policy_faults::test_actions_far_beyond_the_robot_are_noted_in_the_row",),
    ),
    Row(
        "camera frames of NaN or infinity; a camera that is gone or new in the middle of an "
        "episode",
        "one line names it; nothing reaches the policy, and the next whole frame goes on",
        ("test_lerobot_loop::test_a_camera_that_fails_is_named_and_nothing_reaches_the_policy",),
    ),
    Row(
        "an own encoder that gives NaN",
        "one line; nothing is elected",
        ("test_vote::test_numbers_that_are_not_finite_elect_nothing",),
    ),
    Row(
        "10,000 candidates; none",
        "the vote elects; none is a result",
        (
            "test_vote::test_ten_thousand_candidates_are_no_trouble",
            "test_vote::test_no_candidate_is_a_result",
        ),
    ),
    Row(
        "a chat endpoint that is silent, slow, endless, or lies about its length",
        "one line, within its limits of time and 4 MB",
        (
            "test_describe::test_an_answer_without_end_is_given_up",
            "test_describe::test_no_server_and_a_silent_one_are_said",
        ),
    ),
    Row(
        "a run that is killed or interrupted at random moments, and goes on",
        "no row lost, table equal to an undisturbed run",
        (
            "test_engine::test_killed_in_the_middle_it_ends_with_the_rows_of_an_undisturbed_run",
            "test_engine::test_killed_twenty_times_it_ends_with_the_rows_of_an_undisturbed_run",
        ),
    ),
    Row(
        "`report` over an earlier report, `ground` on a clip, `objects import`: SIGKILL at random "
        "moments",
        "each file is the earlier or the new one, whole; the same command ends as undisturbed",
        ("test_kills::test_work_that_is_killed_at_random_moments_leaves_whole_files",),
    ),
    Row(
        "`train policy` and `train vlm`: SIGKILL at random moments",
        "the weights of an undisturbed training, bit for bit",
        ("test_policy_training::test_a_training_that_is_killed_at_random_moments_ends_the_same",),
    ),
    Row(
        "a notebook that keeps figures and tables: its executor is killed at random moments",
        "what is kept is whole, the kernel ends by itself, and the next execution ends the same",
        ("test_kills::test_a_notebook_that_is_killed_leaves_whole_files_and_no_kernel",),
    ),
    Row(
        "a run that is killed before its first job ends",
        "goes on with jobs of one episode",
        ("test_engine::test_a_run_that_goes_on_begins_with_short_jobs",),
    ),
    Row(
        "an episode whose worker is killed again and again; every worker killed",
        "an `error` row after three deaths, the others are kept; the run ends in one line and "
        "blames no episode",
        (
            "test_engine::test_an_episode_that_ends_its_workers_is_an_error_and_the_others_are_kept",
            "test_engine::test_where_every_worker_dies_the_run_ends_and_blames_no_episode",
        ),
    ),
    Row(
        "`report` over an earlier report, ended before each of its renames",
        "each file is the earlier or the new one, whole; the same command ends as undisturbed",
        ("test_kills::test_a_report_that_is_ended_keeps_or_replaces_each_file_of_an_earlier_one",),
    ),
    Row(
        "`ground` on a clip, ended before each of its renames",
        "no half film or recording has its name",
        ("test_kills::test_a_clip_that_is_ended_leaves_no_half_film",),
    ),
    Row(
        "`train policy`, ended before each of its renames",
        "the weights of an undisturbed training, bit for bit",
        (
            "test_policy_training::"
            "test_a_training_that_is_ended_again_and_again_ends_like_one_that_was_not",
        ),
    ),
    Row(
        "a clock that is set back or forward",
        "limits read the monotonic clock; the clock of the day decides the age of scratch files "
        "alone",
        (
            "test_promises::test_limits_of_time_are_of_a_clock_that_nobody_sets",
            "test_promises::test_a_clock_that_was_set_back_makes_no_scratch_file_old",
        ),
    ),
    Row(
        "a replacement of an object that is killed between its renames",
        "the former object is found",
        ("test_scan_storage::test_a_replacement_killed_between_its_renames_loses_nothing",),
    ),
    Row(
        "leftovers of killed writes",
        "swept after an hour; unfinished recordings stay",
        (
            "test_engine::test_leftovers_of_killed_writes_are_removed_but_no_recording",
            "test_memory::test_what_a_killed_save_left_is_removed_when_it_is_old",
        ),
    ),
    Row(
        "a memory file that lies about its name; an object with a path for a name",
        "refused",
        (
            "test_memory::test_a_file_is_not_believed_about_its_name",
            "test_memory::test_an_object_of_a_bad_name_is_not_saved",
        ),
    ),
    Row(
        "a cluster's worker that names a file outside the run",
        "refused; nothing is written",
        ("test_cluster::test_a_worker_writes_into_the_run_alone",),
    ),
    Row(
        "24 rows of simpler-bridge under `lerobot-eval`, with the plain policy and with VAP attached",
        "the successes of our engine, row by row",
        ("test_lerobot_plugin::test_lerobots_own_command_gives_the_successes_of_our_engine",),
    ),
    Row(
        "the same episodes in another process under another hash seed",
        "actions, outcomes and steps equal to the bit",
        ("test_determinism::test_another_process_and_hash_seed_change_no_bit",),
    ),
    Row(
        "the same episodes in batches of 1 and 2, with 1 and 2 threads (a run's workers have one)",
        "equal outcomes; actions of the first 8 steps within 2e-5 m or rad, then, as a pixel can be "
        "rounded otherwise, within 0.02",
        ("test_determinism::test_batches_and_threads_change_the_last_bits_alone",),
    ),
    Row(
        "pickle, eval, shell and remote code in the package",
        "none, but for one reader of a file of known digest that refuses all names but a tensor's",
        (
            "test_promises::test_no_module_reads_what_can_execute",
            "test_extras::test_a_file_of_tensors_executes_nothing",
            "test_extras::test_another_file_than_the_published_one_is_not_read",
        ),
    ),
    Row(
        "sockets that listen",
        "loopback alone",
        ("test_promises::test_sockets_are_seen_and_reruns_server_opens_them_on_loopback_alone",),
    ),
    Row(
        "connections of the viewer, of Ray and of JupyterLab",
        "none outward",
        (
            "test_outgoing::test_the_viewer_connects_to_nothing_outside",
            "test_outgoing::test_ray_reports_nothing",
            "test_outgoing::test_jupyterlab_fetches_neither_news_nor_versions",
        ),
    ),
    Row(
        "the key of a chat endpoint",
        "read in one place, in no message",
        (
            "test_promises::test_keys_are_read_in_one_place_and_shown_in_none",
            "test_describe::test_what_goes_wrong_is_one_line",
        ),
    ),
)

ATTACKS = (
    Attack(
        "1",
        "high",
        "a picture with EPS content started Ghostscript",
        "formats are named; nothing starts",
        (
            "test_memory::test_a_photo_starts_no_program",
            "test_scan_files::test_a_texture_starts_no_program",
        ),
    ),
    Attack(
        "2",
        "high",
        "`objects import --replace`, killed between its renames, lost the object",
        "the former object is found",
        ("test_scan_storage::test_a_replacement_killed_between_its_renames_loses_nothing",),
    ),
    Attack(
        "3",
        "high",
        "pictures of recordings started the viewer with analytics on",
        "analytics are off in every process of Rerun",
        (
            "test_outgoing::test_rerun_leaves_no_configuration_in_the_home",
            "test_outgoing::test_every_process_of_rerun_gets_that_environment",
            "test_outgoing::test_the_viewer_connects_to_nothing_outside",
        ),
    ),
    Attack(
        "4",
        "high",
        "several first starts at once were let into one new folder",
        "one is let in: the lock file is never renamed",
        ("test_store::test_of_two_that_start_one_run_at_once_one_is_let_in",),
    ),
    Attack(
        "5",
        "medium",
        "of two `register` of one name at once both said saved",
        "one is refused",
        (
            "test_memory::test_of_two_that_register_one_name_at_once_one_is_refused",
            "test_scan_storage::test_another_process_may_take_the_name_first",
            "test_publish::test_of_two_that_publish_one_table_at_once_one_is_refused",
        ),
    ),
    Attack(
        "6",
        "medium",
        "the import of a mesh whose charts do not fit never ended",
        "refused in one line",
        (
            "test_scan_files::test_a_surface_that_cannot_be_reduced_is_refused",
            "test_scan_files::test_more_charts_than_fit_are_refused",
        ),
    ),
    Attack(
        "7",
        "medium",
        "convex decomposition of broken meshes took minutes, deaf to Ctrl-C",
        "a process of its own, with a limit and a remedy",
        (
            "test_scan_files::test_splitting_that_does_not_end_is_ended",
            "test_scan_files::test_a_splitter_that_waits_is_ended",
        ),
    ),
    Attack(
        "7a",
        "medium",
        "one flipped bit in a recording ended a whole query",
        "the recording is named, the others answer",
        (
            "test_catalog::test_a_recording_that_ends_its_reader_is_named_and_the_others_are_read",
            "test_catalog::test_flipped_bits_leave_a_query_its_other_recordings",
        ),
    ),
    Attack(
        "8",
        "medium",
        "conditions ended the process or took all memory",
        "limits of length, depth, functions and time",
        ("test_condition::test_what_could_end_the_process_is_refused",),
    ),
    Attack(
        "9",
        "medium",
        "a policy that returned None or too few chunks ended the whole call",
        "one line names what the protocol asks for",
        ("test_policy_faults::test_what_breaks_the_protocol_ends_the_run_in_one_line",),
    ),
    Attack(
        "10",
        "medium",
        "a policy that called `sys.exit` ended the run, silently",
        "the error of its episode",
        (
            "test_policy_faults::test_sys_exit_at_the_start_of_an_episode_is_its_error",
            "test_policy_faults::test_sys_exit_in_a_worker_does_not_end_this_process",
        ),
    ),
    Attack(
        "11",
        "medium",
        "a policy that hung held the run for ever",
        "`--policy-timeout`; a note says which episode waits",
        (
            "test_policy_faults::test_a_call_that_hangs_is_ended",
            "test_policy_faults::test_without_a_limit_a_note_says_which_episode_waits",
        ),
    ),
    Attack(
        "12",
        "medium",
        "deeply nested JSON was an uncaught RecursionError",
        "one reader of JSON; one line",
        (
            "test_promises::test_json_from_outside_has_one_reader",
            "test_memory::test_json_nested_too_deep_is_said",
            "test_store::test_a_manifest_nested_too_deep_is_damaged",
            "test_scan_storage::test_metadata_nested_too_deep_is_damaged",
            "test_run_schema::test_a_published_table_with_other_notes_is_refused",
            "test_lerobot::test_what_is_missing_or_damaged_is_one_line",
        ),
    ),
    Attack(
        "13",
        "medium",
        "a damaged object folder with matching checksums: errors of its decoders",
        "one line",
        ("test_scan_storage::test_whatever_a_decoder_raises_is_one_line",),
    ),
    Attack(
        "14",
        "medium",
        "photos: errors of their decoders",
        "one line",
        ("test_memory::test_whatever_a_decoder_raises_is_one_line",),
    ),
    Attack(
        "15",
        "medium",
        "meshes: uncaught errors, and a texture that asked for 3.8 GB",
        "checked once after reading; large textures are refused before they are decoded",
        (
            "test_hostile_meshes::test_a_broken_surface_is_one_line",
            "test_hostile_meshes::test_indices_beyond_the_vertices_are_refused",
            "test_hostile_meshes::test_fewer_texture_coordinates_than_vertices_are_refused",
            "test_scan_files::test_a_texture_of_too_many_pixels_is_refused",
        ),
    ),
    Attack(
        "16",
        "medium",
        "run folders and published tables: about 20 kinds of uncaught errors",
        "one schema where they enter; one line",
        (
            "test_run_schema::test_any_note_of_a_run_is_read_or_refused",
            "test_run_schema::test_any_column_of_a_run_is_read_or_refused",
            "test_run_schema::test_a_published_table_with_other_notes_is_refused",
        ),
    ),
    Attack(
        "17",
        "medium",
        "checkpoint pipelines named modules that were imported",
        "classes are compared with lerobot's steps; nothing that a file names is imported",
        (
            "test_lerobot::test_files_are_parsed_never_executed",
            "test_lerobot::test_what_is_missing_or_damaged_is_one_line",
        ),
    ),
    Attack(
        "18",
        "low",
        "a checkpoint that named a tokenizer made loading connect to the hub",
        "look-ups are off while a checkpoint loads",
        ("test_lerobot::test_a_backbone_that_was_not_downloaded_is_named",),
    ),
    Attack(
        "19",
        "low",
        "a memory file was believed about its name",
        "names inside are checked like those typed",
        (
            "test_memory::test_a_file_is_not_believed_about_its_name",
            "test_memory::test_an_object_of_a_bad_name_is_not_saved",
        ),
    ),
    Attack(
        "20",
        "low",
        "a write that failed left its scratch for ever",
        "removed at once, or swept by the next start",
        (
            "test_scan_storage::test_a_write_that_fails_leaves_no_scratch",
            "test_memory::test_what_a_killed_save_left_is_removed_when_it_is_old",
            "test_engine::test_leftovers_of_killed_writes_are_removed_but_no_recording",
        ),
    ),
    Attack(
        "21",
        "low",
        "the error for a bad condition was as long as the condition; a column `line` was hidden",
        "at most 600 characters; a column of any name can be asked",
        (
            "test_condition::test_what_could_end_the_process_is_refused",
            "test_condition::test_a_column_of_any_name_can_be_asked",
        ),
    ),
    Attack(
        "22",
        "low",
        "one object saved six times gave six different files",
        "equal objects are equal bytes",
        ("test_memory::test_equal_objects_are_equal_bytes",),
    ),
    Attack(
        "23",
        "low",
        "with two threads actions differ in their last bits",
        "workers of a run have one thread; elsewhere the tolerance is tested",
        (
            "test_policy_faults::test_a_worker_has_one_thread_whatever_the_environment_says",
            "test_determinism::test_batches_and_threads_change_the_last_bits_alone",
        ),
    ),
    Attack(
        "24",
        "low",
        "a pipe as memory, mesh or material was waited for",
        "regular files only",
        (
            "test_pipes::test_a_pipe_is_not_waited_for",
            "test_hostile_meshes::test_a_pipe_beside_an_obj_is_not_waited_for",
            "test_hostile_meshes::test_a_mesh_that_is_a_pipe_is_refused",
        ),
    ),
    Attack(
        "25",
        "low",
        "a run killed every 20 s kept nothing, for a job was five episodes",
        "a run that goes on begins with jobs of one episode",
        (
            "test_engine::test_a_run_that_goes_on_begins_with_short_jobs",
            "test_engine::test_killed_twenty_times_it_ends_with_the_rows_of_an_undisturbed_run",
        ),
    ),
    Attack(
        "26",
        "low",
        "set-up did not insist on the hashes of its packages",
        "every install of packages requires their hashes",
        ("test_promises::test_set_up_installs_nothing_without_its_hash",),
    ),
)

LEFT = (
    (
        "a run of a trained policy that is interrupted and goes on",
        "its policy is asked in batches of other sizes, so the last bits of an action differ, and "
        "an episode at the edge can end otherwise; with scripted and random policies rows are equal",
    ),
    (
        "a clock that is set forward by over an hour while a command writes",
        "another command may take its scratch file for abandoned; the write then fails, and "
        "nothing finished is lost",
    ),
    (
        "a Ray cluster that loses a node; a cluster that is not trusted",
        "a worker's death is one line and resumes; Ray executes code by design: join clusters that "
        "you trust",
    ),
    (
        "machines with other CPU features",
        "the last bits of an action can differ, and with them an outcome at the edge; equal on one "
        "machine",
    ),
    (
        "other policies of lerobot under its own commands",
        "where a loop does not freeze the weights, PyTorch may choose another kernel, and the last "
        "bits differ; mini-pi0 freezes itself while it samples",
    ),
    (
        "a call into C that never returns inside an import",
        "the time limit interrupts Python between calls; the decomposition has a process of its "
        "own",
    ),
    (
        "known vulnerabilities",
        "`make audit` asks the package index; it needs the internet and is no part of `make test`",
    ),
)
