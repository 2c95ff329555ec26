# SPDX-License-Identifier: MIT
"""What must never happen, each invariant with the tests that try to break it, and what the core promises to its drivers.

Quoted is what the documentation promises; the tests stand in the rooms that keep it.
"""

from __future__ import annotations

from named_tests import check_named

NEVER = {
    "1 outputs are one commit's or safe": "test_outputs.py::test_outputs_are_zeros_or_of_a_commit_that_lives "
                                          "test_dp_master.py::test_outputs_of_one_commit_and_inputs_of_one_telegram "
                                          "test_image.py::test_two_threads_never_see_half_a_frame_nor_a_stale_commit "
                                          "test_master_pty.py::test_every_commit_is_sent_whole_and_in_order "
                                          "test_dp_master.py::test_a_program_that_hangs_while_nothing_takes_its_outputs",
    "1 safe is zeros, or nothing for a fail-safe slave":
        "test_dp_master.py::test_clear_sends_zeros_and_a_fail_safe_slave_nothing",
    "2 a bad telegram changes a counter only": "test_noise.py::test_one_octet_of_any_telegram "
                                               "test_noise.py::test_a_noisy_line_for_a_long_time "
                                               "test_fdl.py::test_an_answer_with_a_line_error_is_no_answer",
    "3 the program dies": "test_safety.py::test_a_killed_master_is_noticed_by_the_slaves_watchdog_which_is_on_by_default "
                          "test_safety.py::test_a_child_that_outlives_its_parent_keeps_no_drive_running",
    "3 slave watchdogs by default": "test_timing.py::test_the_masters_default_watchdog_is_the_planners "
                                    "test_master_api.py::test_a_default_watchdog_that_is_too_long",
    "3 the program hangs": "test_safety.py::test_a_program_that_hangs_loses_its_outputs "
                           "test_safety.py::test_after_a_hang_nothing_moves_until_operate_and_a_new_command "
                           "test_dp_master.py::test_the_output_watchdog_makes_everything_safe_and_latches",
    "3 what feeds": "test_master_pty.py::test_what_feeds_the_output_watchdog",
    "3 never reads, events or other threads": "test_master_pty.py::test_what_does_not_feed_the_output_watchdog "
                                              "test_master_pty.py::test_a_later_thread_is_not_the_one_that_committed "
                                              "test_aio.py::test_an_event_loop_that_hangs_lets_the_watchdog_run_out "
                                              "test_master_pty.py::test_operating_again_and_again_does_not_feed",
    "3 what was written before is never sent again":
        "test_dp_master.py::test_the_output_watchdog_stops_a_repetition "
        "test_dp_master.py::test_a_stopped_process_comes_back_with_safe_outputs",
    "3 off is logged": "test_master_pty.py::test_no_output_watchdog_is_logged",
    "3 the stop word before Clear": "test_master_pty.py::test_the_stop_word_comes_before_clear "
                                    "test_master_pty.py::test_no_other_thread_commits_between_the_stop_word_and_clear "
                                    "test_master_pty.py::test_a_stop_word_that_fails_keeps_nobody",
    "3 a drive set to hold is named": "test_drive_pty.py::test_a_drive_that_would_run_on_is_named_at_operate",
    "3 who leaves leaves nobody behind": "test_disturbances.py::test_a_disturbance_at_any_moment_is_over_when_it_is_over "
                                         "test_dp_master.py::test_what_the_host_itself_was_away_is_not_waited_for "
                                         "test_dp_master.py::test_an_unlock_that_is_a_first_contact_is_repeated_all_the_same",
    "4 back with safe outputs": "test_dp_master.py::test_it_comes_back_with_safe_outputs_and_only_a_new_commit_reaches_it "
                                "test_port_returns.py::test_the_exchange_resumes_by_itself_with_safe_outputs "
                                "test_drive.py::test_a_loss_while_a_word_is_changed_carries_no_run_command_over",
    "4 hold": "test_dp_master.py::test_hold_keeps_the_outputs_of_a_bare_station "
              "test_dp_modes.py::test_deactivated_with_outputs_under_way_they_are_not_sent_again "
              "test_dp_modes.py::test_new_prm_goes_from_data_to_set_prm_and_on",
    "5 not longer, not more often, not later": "test_simulation.py::test_a_master_and_its_slaves_break_no_rule "
                                               "test_fdl.py::test_a_host_that_was_away_listens_before_it_talks "
                                               "test_ring.py::test_a_request_that_may_be_old_is_not_answered "
                                               "test_dp_modes.py::test_min_slave_interval_counts_from_a_repetition "
                                               "test_dp_modes.py::test_min_slave_interval_holds_whatever_a_program_does",
    "5 the token is passed": "test_ring.py::test_the_token_is_not_kept_when_there_is_nothing_to_do "
                             "test_ring.py::test_one_high_priority_cycle_even_when_the_rotation_took_too_long",
    "5 gives way to a foreign token": "test_fdl.py::test_goes_silent_on_a_foreign_token "
                                      "test_dp_master.py::test_a_foreign_master_takes_the_bus_and_all_stations_are_safe_afterwards",
    "6 one clear error": "test_user_errors.py::test_a_missing_port test_user_errors.py::test_a_port_that_vanishes "
                         "test_master_api.py::test_bad_arguments_are_named "
                         "test_gsd.py::test_any_text_gives_a_model_and_findings "
                         "test_users.py::test_a_request_on_a_port_that_is_gone_fails_with_the_reason",
    "6 nothing half made": "test_master_api.py::test_a_failed_open_leaves_nothing_behind "
                           "test_master_api.py::test_a_begin_that_fails_can_be_tried_again_and_leaves_nothing_behind",
    "7 fork": "test_master_api.py::test_a_forked_child_may_not_touch_the_bus "
              "test_safety.py::test_a_forked_childs_end_disturbs_nothing",
    "7 O_CLOEXEC": "test_port.py::test_the_descriptor_does_not_reach_other_programs",
    "7 Ctrl-C": "test_safety.py::test_ctrl_c_leaves_through_stop_word_clear_and_unlock "
                "test_errors.py::test_ctrl_c_leaves_a_wait_without_end "
                "test_master_pty.py::test_ctrl_c_at_any_moment_takes_a_request_back "
                "test_master_pty.py::test_ctrl_c_at_any_moment_takes_a_global_control_back "
                "test_master_pty.py::test_a_signals_handler_may_do_what_it_interrupted "
                "test_services.py::test_a_second_ctrl_c_skips_the_stop_word_but_not_clear_and_unlock",
    "7 close()": "test_master_api.py::test_closed_is_closed test_master_api.py::test_close_wakes_every_waiter "
                 "test_master_api.py::test_closing_leaves_nothing_behind "
                 "test_master_pty.py::test_requests_given_up_while_the_bus_is_left_keep_their_memory "
                 "test_master_pty.py::test_a_subscription_ended_while_the_bus_is_left_gives_its_descriptor_to_nobody "
                 "test_port_returns.py::test_closing_without_a_port_is_bounded",
    "7 before the interpreter is gone": "test_safety.py::test_a_program_that_ends_leaves_as_well "
                                        "test_master_api.py::test_closing_while_the_interpreter_ends_ends_the_thread",
}

CORE = {
    "no allocation": "test_allocation.py::test_thousands_of_exchanges_allocate_nothing",
    "octets between their earliest and latest time": "test_simulation.py::test_times_of_a_late_host_hold_the_truth "
                                                     "test_port.py::test_octets_come_with_the_interval_in_which_they_ended",
    "nothing unread up to h": "test_port.py::test_quiet_reaches_up_to_the_begin_of_the_read",
    "any octet revokes an offer": "test_simulation.py::test_carrier_is_known_when_the_first_octet_has_ended",
    "past not-after it is dropped and counted": "test_fdl.py::test_a_host_that_was_away_listens_before_it_talks "
                                                "test_bus.py::test_what_is_offered_too_late_is_not_sent",
    "missing is proved": "test_fdl.py::test_a_time_out_is_judged_only_by_silence",
    "only a certain gap drops": "test_receiver.py::test_a_certain_gap_breaks_a_telegram_and_the_next_is_found_at_once "
                                "test_receiver.py::test_an_uncertain_pause_is_counted_and_never_a_reason_to_drop",
    "minima up, maxima down": "test_parameters.py::test_nanoseconds_are_exact_and_rounded_up_or_down",
    "running out is an error": "test_dp_master.py::test_set_up_refuses_what_cannot_work "
                               "test_master_api.py::test_no_more_stations_than_room",
    "the end of a transmission": "test_port.py::test_an_unpaced_transmission_ends_when_write_returns "
                                 "test_port.py::test_a_paced_transmission_ends_after_eleven_bits_a_character "
                                 "test_port.py::test_of_a_pty_of_unknown_pace_the_end_is_an_interval",
    "a ring needs room for the allowance": "test_ring.py::test_a_host_that_wakes_late_needs_room_in_the_slot",
    "a slave's late answer is dropped and counted": "test_slave.py::test_a_late_host_drops_the_answer_and_counts_it",
    "waits end in a short spin": "test_port.py::test_octets_end_a_wait_in_the_sleep_and_in_the_spin",
    "the thread takes no signal": "test_bus.py::test_the_thread_takes_no_signal",
    "what one port writes all others hear": "test_segment.py::test_what_one_port_writes_all_others_hear",
    "a client that dies leaves no loop": "test_segment.py::test_an_abandoned_port_costs_no_cpu "
                                         "test_segment.py::test_a_client_that_dies_leaves_the_port_to_the_next",
    "wait_sent, and parts by several threads": "test_master_pty.py::test_threads_commit_their_own_octets "
                                               "test_image.py::test_a_commit_was_sent_when_it_or_a_later_one_was_answered",
    "after a loss the octets stay and validity is gone": "test_master_pty.py::test_a_lost_station_comes_back_with_safe_outputs",
    "a full ring drops the oldest and says how many": "test_event.py::test_a_full_ring_drops_the_oldest_and_says_how_many "
                                                      "test_master_api.py::test_a_full_ring_drops_the_oldest_and_says_how_many",
}


def test_every_promise_names_a_test() -> None:
    check_named(NEVER)
    check_named(CORE)
