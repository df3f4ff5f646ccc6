"""The usual causes, injected on real DDS, are named in the status with their remedy."""


def robot_with(graph, **camera):
    robot = graph.peer("robot")
    robot.base(), robot.watch(), robot.e_stop()
    robot.camera(**camera)
    return robot


def test_camera_clock_that_is_off_is_named_by_how_much_and_the_drive_goes_on_when_it_is_set(graph, policy):
    robot = robot_with(graph)
    robot.clock_offset = -10.0
    graph.start("drive", policy)
    robot.wait_for_status(driving=False, causes="camera's clock is 10.0")
    robot.clock_offset = 0.0
    robot.wait_for_status(driving=True, causes="[]")


def test_unreadable_encoding_is_named_while_it_lasts_and_blamed_for_no_later_stop(graph, policy):
    robot = robot_with(graph)
    robot.encoding = "8UC3"
    graph.start("drive", policy)
    robot.wait_for_status(driving=False, causes="8UC3")
    robot.encoding = "rgb8"
    robot.wait_for_status(driving=True)
    second = graph.peer("second")
    second.camera()
    status = robot.wait_for_status(driving=False, holds="an input has two publishers",
                                   causes="2 publishers (/robot, /second)")
    assert "8UC3" not in str(status)
    graph.peers.remove(second), second.close()
    robot.wait_for_status(driving=True, causes="[]")


def test_base_that_listens_to_another_type_than_is_sent_is_named_and_nothing_drives(graph, policy):
    robot = graph.peer("robot")
    robot.base(kind="geometry_msgs/TwistStamped"), robot.watch(), robot.camera(), robot.e_stop()
    graph.start("drive", policy, "--command-type", "Twist")
    robot.wait_for_status(state="standing", reason="no base listens", causes="listens to geometry_msgs/msg/TwistS")


def test_image_topic_of_another_type_is_named(graph, policy):
    robot = graph.peer("robot")
    robot.base(), robot.watch(), robot.e_stop()
    robot.publisher("sensor_msgs/CompressedImage", "sensing/camera/front/image_raw")
    graph.start("drive", policy)
    robot.wait_for_status(reason="no frame yet", causes="--compressed")


def test_emergency_stop_of_two_publishers_holds_the_vehicle_and_both_are_named(graph, policy):
    robot = robot_with(graph)
    graph.start("drive", policy)
    robot.wait_for_status(driving=True)
    second = graph.peer("second")
    second.e_stop()
    robot.wait_for_status(driving=False, holds="a safety signal has two publishers", causes="(/robot, /second)")
    graph.peers.remove(second), second.close()
    robot.wait_for_status(driving=True, causes="[]")
